"""Run a segmentation model, which finds the object's pixels in a single photo: RefGS's own, or an ONNX file that the artist supplies.

ONNX Runtime runs in a child process, because it ends its process for some damaged files.
"""

import multiprocessing
import signal
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from refgs.errors import InputError, reason

MODEL = Path(__file__).with_name("isnet.onnx")  # RefGS's own; `scripts/fetch_model.py` brings it
SIDE = 1024  # pixels that a model of any size gets
# Mean and standard deviation of the 8-bit values: as MODEL was trained, and of ImageNet.
OURS = np.array([128, 256], np.float32)
IMAGENET = np.array([[123.675, 116.28, 103.53], [58.395, 57.12, 57.375]], np.float32)


class SalienceModel:
    """Model of salient-object segmentation, such as U²-Net, IS-Net or BiRefNet, on the CPU.

    The model's input is a photo (1, 3, height, width) float32 RGB. Its values are normalised as for ImageNet; those of MODEL, as it was
    trained. Its first output is one number for each pixel. If any of these numbers is negative, they are all logits. If none is negative
    but one is greater than 1, they are all scaled to 0..1. Otherwise they are probabilities. `side` is the longer side of the input, in
    pixels. Raises InputError if the file is missing, damaged or another type of model.
    """

    def __init__(self, file: Path):
        self.file = Path(file)
        if not self.file.is_file():
            raise InputError(f"{file}: there is no such file. --model needs a model in ONNX format.")
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # It ends when the pipe is closed, at the latest with this object.
        self._process = context.Process(target=_child, args=(self.file, theirs), daemon=True)
        self._process.start()
        theirs.close()
        self._height, self._width = self._answer()
        self.side = max(self._height, self._width)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the probability that each pixel shows the object, (H, W) float32, for a photo (H, W, 3) uint8 sRGB."""
        with suppress(OSError):  # `_answer` says why the pipe is closed
            way = cv2.INTER_AREA if image.shape[1] > self._width else cv2.INTER_CUBIC
            self._pipe.send(cv2.resize(image, (self._width, self._height), interpolation=way))
        return cv2.resize(self._answer(), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)

    def _answer(self) -> Any:
        try:
            while not self._pipe.poll(0.2):  # short, because an interrupt does not wake it
                pass
            answer = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            if self._process.exitcode == -9:
                raise MemoryError from None  # Linux kills the largest program when memory is full
            what = f"ONNX Runtime ended while it used it (status {self._process.exitcode})"
            raise InputError(f"{self.file}: {what}: the file is damaged. Download it again.") from None
        if isinstance(answer, InputError):
            raise answer
        return answer


def _child(file: Path, pipe: Connection) -> None:
    """Run a model in the child process. First send its input's height and width. Then, for each photo received, send the probabilities.

    If the model or a photo fails, send the InputError and end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    try:
        session, size = _load(file)
        pipe.send(size)
        while True:
            pipe.send(_run(file, session, pipe.recv()))
    except InputError as error:
        pipe.send(error)
    except (EOFError, OSError):  # the parent is gone, or has no more photos
        pass


def _load(file: Path) -> tuple[Any, tuple[int, int]]:
    """Load a model. Return its ONNX Runtime session, and the height and width of its input in pixels."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # its warnings are about the graph, which the artist did not make
    # Threads that wait must not keep a core busy: 2.9 s of the processor for a photo instead of 3.4, and as much less on the clock.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        (taken, *more), found = session.get_inputs(), session.get_outputs()
    except Exception as error:  # its exceptions have no common class
        raise InputError(f"{file}: ONNX Runtime cannot read it: {reason(error)}") from None
    shape = taken.shape
    if more or len(shape) != 4 or shape[1] not in (3, None) or taken.type != "tensor(float)" or not found:
        raise InputError(
            f"{file}: its input is {taken.type} {shape}, not one RGB photo (1, 3, height, width) of float32. "
            "Take a model of salient-object segmentation."
        )
    height, width = (size if isinstance(size, int) and size > 0 else SIDE for size in shape[2:])
    if max(height, width) > 1 << 13:
        raise InputError(f"{file}: it wants photos of {width}×{height} pixels. Take a model for smaller ones.")
    return session, (height, width)


def _run(file: Path, session: Any, image: np.ndarray) -> np.ndarray:
    """Return the object's probability at each pixel (H, W) of a photo (H, W, 3) uint8 that has the size of the model's input."""
    mean, deviation = OURS if file == MODEL else IMAGENET
    batch = np.ascontiguousarray(((image - mean) / deviation).transpose(2, 0, 1)[None])
    try:
        found = session.run([session.get_outputs()[0].name], {session.get_inputs()[0].name: batch})[0]
        shape, found = np.shape(found), np.asarray(found, np.float32).squeeze()
    except Exception as error:
        raise InputError(f"{file}: the model failed: {reason(error)}") from None
    if found.ndim != 2 or not np.isfinite(found).all():
        raise InputError(f"{file}: its first output, of shape {shape}, is not one map of finite values.")
    if found.min() < 0:
        found = 1 / (1 + np.exp(-np.clip(found, -50, 50)))
    elif found.max() > 1:
        found = (found - found.min()) / max(np.ptp(found), 1e-6)
    return found
