"""Make tiny ONNX models that find red, for masks by a model."""

import numpy as np
import onnx
from onnx import TensorProto, helper

REDNESS = np.float32([2.0, -2.0, -1.0]).reshape(1, 3, 1, 1)  # of values normalised by ImageNet's mean and deviation


def write_model(file, size, last="Identity", weights=REDNESS):
    """Write a model whose output is `last` of a weighted sum of channels. `size` (height, width) is numbers or names."""
    channels = weights.shape[:2]
    nodes = [
        helper.make_node("Conv", ["photo", "weights"], ["sum"]),
        helper.make_node(last, ["sum"], ["found"]),
    ]
    graph = helper.make_graph(
        nodes,
        "red",
        [helper.make_tensor_value_info("photo", TensorProto.FLOAT, [1, channels[1], *size])],
        [helper.make_tensor_value_info("found", TensorProto.FLOAT, [1, channels[0], *size])],
        [helper.make_tensor("weights", TensorProto.FLOAT, weights.shape, weights.ravel())],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), file)
    return file
