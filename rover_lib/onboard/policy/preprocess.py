"""Turn a camera's frame into the policy's input, in the same way in training, calibration, comparison and on the Pi."""

import cv2
import numpy as np

from rover_lib.onboard.errors import PolicyError

# torchvision's ImageNet statistics, RGB, for pixels in [0, 1]: what LeRobot's ACT was trained with.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def prepare_frame(frame_bgr: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize and reorder one camera frame; the aspect ratio is not kept, as in the trainer.

    Args:
        frame_bgr: (h, w, 3) uint8 of any size, as OpenCV gives it.
        height: in pixels, the policy's.
        width: likewise.

    Returns:
        (height, width, 3) uint8 RGB, contiguous, not normalised: the artifact's graph does that.

    Raises:
        PolicyError: for anything that is not such a picture.
    """
    if not isinstance(frame_bgr, np.ndarray) or frame_bgr.ndim != 3 or frame_bgr.shape[2] != 3:
        actual = getattr(frame_bgr, "shape", type(frame_bgr).__name__)
        raise PolicyError("a frame must be (height, width, 3) BGR", found=actual, remedy="does the camera give colour?")
    h, w = frame_bgr.shape[:2]
    if frame_bgr.dtype != np.uint8 or h == 0 or w == 0:
        actual = f"{w}x{h} of {frame_bgr.dtype}"
        raise PolicyError("a frame must be pixels of uint8", found=actual, remedy="pass the picture as OpenCV reads it")
    if (h, w) != (height, width):
        interpolation = cv2.INTER_AREA if height < h or width < w else cv2.INTER_LINEAR
        frame_bgr = cv2.resize(frame_bgr, (width, height), interpolation=interpolation)
    return cv2.cvtColor(frame_bgr, cv2.COLOR_BGR2RGB)
