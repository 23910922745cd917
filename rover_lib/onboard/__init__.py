"""All that runs on the rover. Needs torch, numpy, cv2, pyserial and the standard library, nothing else of ours."""

from rover_lib.onboard.policy import Policy, load_policy

__all__ = ["Policy", "load_policy"]
