"""The networks that the learner trains, in torch. Small networks also have a pass in numpy (`kernels/`)."""
