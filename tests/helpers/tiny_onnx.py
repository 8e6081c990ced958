"""Networks of one or two operations in files of ONNX: what is between pictures and depth can be computed by hand."""

from pathlib import Path

from onnx import TensorProto, checker, helper, save

OPSET, IR_VERSION = 17, 9  # that onnxruntime has read for years


def save_network(
    path: Path,
    *,
    shape: tuple[int | str, ...] = (1, 3, 12, 16),
    inverse: bool = False,
    weights: tuple[float, ...] = (1.0, 0.0, 0.0),
    outputs: tuple[str, ...] = ("depth",),
    kind: int = TensorProto.FLOAT,
) -> Path:
    """A network that gives a weighted sum of the colours of a channels-first picture, or one over that."""
    rows, columns = shape[-2:]
    colours = helper.make_tensor("colours", TensorProto.FLOAT, (1, 3, 1, 1), weights)
    axis = helper.make_tensor("axis", TensorProto.INT64, (1,), (len(shape) - 3,))
    picture = "picture"
    nodes = []
    if kind != TensorProto.FLOAT:
        nodes.append(helper.make_node("Cast", [picture], ["floats"], to=TensorProto.FLOAT))
        picture = "floats"
    nodes.append(helper.make_node("Mul", [picture, "colours"], ["weighted"]))
    nodes.append(helper.make_node("ReduceSum", ["weighted", "axis"], ["sum"], keepdims=1))
    nodes += [helper.make_node("Reciprocal" if inverse else "Identity", ["sum"], [name]) for name in outputs]
    given = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, (*shape[:-3], 1, rows, columns)) for name in outputs
    ]
    taken = helper.make_tensor_value_info("picture", kind, shape)
    graph = helper.make_graph(nodes, "tiny", [taken], given, [colours, axis])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    checker.check_model(model)
    save(model, str(path))
    return path


def save_any_input(path: Path, shape: tuple[int, ...]) -> Path:
    """A network that gives what it takes."""
    taken, given = (helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("picture", "depth"))
    graph = helper.make_graph([helper.make_node("Identity", ["picture"], ["depth"])], "tiny", [taken], [given])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    save(model, str(path))
    return path
