"""An encoder and a decoder in files of ONNX that take what Segment Anything's take, and mean what is bright."""

from pathlib import Path

from onnx import TensorProto, ValueInfoProto, checker, helper, save
from tiny_onnx import IR_VERSION, OPSET

SIDE, MASK_SIDE = 64, 32  # px
GAIN = 100.0  # of brightness, which outweighs a mask that is shown


def save_sam(folder: Path) -> Path:
    """Both networks, under names that do not tell which is which."""
    folder.mkdir(parents=True, exist_ok=True)
    _save(folder / "one.onnx", _encoder())
    _save(folder / "two.onnx", _decoder())
    return folder


def _encoder() -> tuple[list, list, list, list]:
    """Red, as it is normalised, over 2x2 px."""
    red = helper.make_tensor("red", TensorProto.FLOAT, (1, 3, 1, 1), (GAIN, 0, 0))
    axis = helper.make_tensor("axis", TensorProto.INT64, (1,), (1,))
    nodes = [
        helper.make_node("Mul", ["picture", "red"], ["weighted"]),
        helper.make_node("ReduceSum", ["weighted", "axis"], ["sum"], keepdims=1),
        helper.make_node("AveragePool", ["sum"], ["embedding"], kernel_shape=[2, 2], strides=[2, 2]),
    ]
    return nodes, [_info("picture", 1, 3, SIDE, SIDE)], [_info("embedding", 1, 1, MASK_SIDE, MASK_SIDE)], [red, axis]


def _decoder() -> tuple[list, list, list, list]:
    """The embedding and the mask that is shown, added."""
    quality = helper.make_tensor("quality", TensorProto.FLOAT, (1, 1), (0.9,))
    nodes = [
        helper.make_node("Add", ["image_embeddings", "mask_input"], ["low_res_masks"]),
        helper.make_node("Identity", ["quality"], ["iou_predictions"]),
    ]
    taken = [
        _info("image_embeddings", 1, 1, MASK_SIDE, MASK_SIDE),
        _info("point_coords", 1, "points", 2),
        _info("point_labels", 1, "points"),
        _info("mask_input", 1, 1, MASK_SIDE, MASK_SIDE),
        _info("has_mask_input", 1),
        _info("orig_im_size", 2),
    ]
    given = [_info("low_res_masks", 1, 1, MASK_SIDE, MASK_SIDE), _info("iou_predictions", 1, 1)]
    return nodes, taken, given, [quality]


def _info(name: str, *shape: int | str) -> ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def _save(path: Path, parts: tuple[list, list, list, list]) -> None:
    nodes, taken, given, constants = parts
    graph = helper.make_graph(nodes, "tiny", taken, given, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    checker.check_model(model)
    save(model, str(path))
