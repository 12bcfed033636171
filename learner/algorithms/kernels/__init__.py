"""Forward and backward passes written without autograd, for small networks."""
