"""What to install for a missing Python module if its package has another name, or is needed in an older version. Pure."""

from __future__ import annotations

PACKAGES = {
    "Box2D": "'gymnasium[box2d]'",
    "PIL": "pillow",
    "ale_py": "ale-py opencv-python-headless",
    "cv2": "opencv-python-headless",
    "gym": "gym==0.26.2 shimmy",
    "mujoco": "'gymnasium[mujoco]'",
    "pkg_resources": "'setuptools<81'",  # newer versions no longer contain it
    "pygame": "pygame-ce",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}
"""The arguments of `pip install`. The keys are top-level modules."""


def what_to_install(module: str | None) -> str:
    """What to do about a module that is missing, as the end of a line."""
    package = PACKAGES.get((module or "").partition(".")[0])
    return f"pip install {package or 'it'}, then try again"
