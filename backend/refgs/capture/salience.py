"""Run a model of the artist's own, an ONNX file, that tells the object from its surroundings in one photo."""

import sys
from pathlib import Path

import cv2
import numpy as np

from refgs.errors import InputError, reason

SIDE = 1024  # pixels that a model of any size gets
MEAN, DEVIATION = (
    np.float32([0.485, 0.456, 0.406]),
    np.float32([0.229, 0.224, 0.225]),
)  # of ImageNet's sRGB values in 0..1


class SalienceModel:
    """Model of salient-object segmentation, such as U²-Net, IS-Net or BiRefNet, on the CPU.

    Its input is (1, 3, height, width) float32 RGB, normalised as for ImageNet. Its first output is one map: probabilities; logits if some
    are negative; values of any scale if some are greater than 1. `side` is the longer side of its input, in pixels.
    Raises InputError if the file is no such model, or if ONNX Runtime is not installed.
    """

    def __init__(self, file: Path):
        self.file = Path(file)
        if not self.file.is_file():
            raise InputError(f"{file}: there is no such file. --model needs a model in ONNX format.")
        try:
            import onnxruntime
        except ImportError:
            raise InputError(
                f"{file}: models need ONNX Runtime. Install it: {sys.executable} -m pip install onnxruntime"
            ) from None
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # its warnings are about the graph, which the artist did not make
        try:
            self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its exceptions have no common class
            raise InputError(f"{file}: ONNX Runtime cannot read it: {reason(error)}") from None
        (self._input, *more), shape = self._session.get_inputs(), self._session.get_inputs()[0].shape
        if more or len(shape) != 4 or shape[1] not in (3, None) or self._input.type != "tensor(float)":
            raise InputError(
                f"{file}: its input is {self._input.type} {shape}, not one RGB photo (1, 3, height, width) of float32. "
                "Take a model of salient-object segmentation."
            )
        self._height, self._width = (size if isinstance(size, int) and size > 0 else SIDE for size in shape[2:])
        self.side = max(self._height, self._width)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the probability that each pixel shows the object, (H, W) float32, for a photo (H, W, 3) uint8 sRGB."""
        size = image.shape[1::-1]
        scaled = cv2.resize(image, (self._width, self._height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        batch = np.ascontiguousarray(((scaled - MEAN) / DEVIATION).transpose(2, 0, 1)[None])
        try:
            found = self._session.run([self._session.get_outputs()[0].name], {self._input.name: batch})[0]
        except Exception as error:
            raise InputError(f"{self.file}: the model failed: {reason(error)}") from None
        shape, found = found.shape, np.asarray(found, np.float32).squeeze()
        if found.ndim != 2 or not np.isfinite(found).all():
            raise InputError(f"{self.file}: its first output, of shape {shape}, is not one map of finite values.")
        if found.min() < 0:
            found = 1 / (1 + np.exp(-np.clip(found, -50, 50)))
        elif found.max() > 1:
            found = (found - found.min()) / max(np.ptp(found), 1e-6)
        return cv2.resize(found, size, interpolation=cv2.INTER_LINEAR)
