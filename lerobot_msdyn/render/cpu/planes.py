# mypy: disable-error-code="no-untyped-def"
"""Tuples of SIMD vectors, one per blended plane, and the layout that fixes how many there are at compile time.

A kernel receives a `Layout`; its numba type carries the number of planes, so numba compiles (and caches) one
version of the kernel per size. Calls are padded with zero planes up to one of `SIZES`: any number of feature
channels up to 16 is served by four compilations instead of sixteen.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

from lerobot_msdyn.render.cpu.jit import source_fingerprint
from lerobot_msdyn.render.cpu.records import HEAD
from lerobot_msdyn.render.cpu.simd import (
    LANES,
    broadcast,
    call_llvm,
    constant,
    element_pointer,
    load_vector,
    store_vector,
    vector,
)
from lerobot_msdyn.render.types import MAX_CPU_CHANNELS

SIZES = (4, 8, 12, MAX_CPU_CHANNELS + 1)  # planes; one of them is depth
MOMENTS = 6  # sums over pixels that carry all gradients of a Gaussian's shape, position and opacity


@dataclass(frozen=True)
class Layout:
    """How many planes the kernels blend."""

    planes: int

    @property
    def record(self) -> int:
        """Floats in the record of a projected Gaussian, a multiple of 4."""
        return -(-(HEAD + self.planes) // 4) * 4

    @property
    def sums(self) -> int:
        """Floats in the gradient slot of one Gaussian in one tile: moments, then planes, padded to vectors."""
        return -(-(MOMENTS + self.planes) // LANES) * LANES


def layout_for(channels: int) -> Layout:
    """The smallest layout that holds the feature channels and depth."""
    return Layout(next(size for size in SIZES if size > channels))


class LayoutType(types.Type):
    """numba's type of a `Layout`. The sources' fingerprint makes stale entries of the disk cache miss."""

    def __init__(self, planes: int, sources: str) -> None:
        self.planes = planes
        super().__init__(name=f"Layout(planes={planes}, lanes={LANES}, sources={sources})")


@register_model(LayoutType)
class _LayoutModel(models.OpaqueModel):
    """Nothing of a layout exists at run time."""


@cache
def _layout_type(planes: int) -> LayoutType:
    return LayoutType(planes, source_fingerprint())


@typeof_impl.register(Layout)
def _typeof_layout(value, context):
    return _layout_type(value.planes)


@unbox(LayoutType)
def _unbox_layout(numba_type, value, context):
    return NativeValue(context.context.get_dummy_value())


def _planes_type(layout: LayoutType) -> types.UniTuple:
    return types.UniTuple(vector, layout.planes)


def _unpack(builder, planes) -> list:
    return [builder.extract_value(planes, index) for index in range(planes.type.count)]


def _offset(builder, index, count: int):
    return builder.add(index, ir.Constant(index.type, count))


def _property_of_layout(name: str) -> Callable:
    @intrinsic
    def read(typing, layout):
        value = getattr(Layout(layout.planes), name)

        def generate(context, builder, signature, arguments):
            return ir.Constant(ir.IntType(64), value)

        return types.int64(layout), generate

    return read


plane_count, record_stride = _property_of_layout("planes"), _property_of_layout("record")


@intrinsic
def zero_planes(typing, layout):
    """Zeros in every lane of every plane."""

    def generate(context, builder, signature, arguments):
        return cgutils.pack_array(builder, [constant([0.0] * LANES)] * layout.planes)

    return _planes_type(layout)(layout), generate


@intrinsic
def splat_planes(typing, array, index, layout):
    """`array[index + p]` in every lane of plane p."""

    def generate(context, builder, signature, arguments):
        array, index, _ = arguments
        values = []
        for plane in range(layout.planes):
            pointer = element_pointer(context, builder, signature.args[0], array, _offset(builder, index, plane))
            values.append(broadcast(builder, builder.load(pointer)))
        return cgutils.pack_array(builder, values)

    return _planes_type(layout)(array, types.intp, layout), generate


@intrinsic
def load_planes(typing, array, index, layout):
    """One vector per plane, stored one after the other."""

    def generate(context, builder, signature, arguments):
        array, index, _ = arguments
        values = [
            load_vector(context, builder, signature.args[0], array, _offset(builder, index, plane * LANES))
            for plane in range(layout.planes)
        ]
        return cgutils.pack_array(builder, values)

    return _planes_type(layout)(array, types.intp, layout), generate


@intrinsic
def add_weighted_to_memory(typing, array, index, weight, planes):
    """Array[p] += weight planes[p], in place."""

    def generate(context, builder, signature, arguments):
        array, index, weight, planes = arguments
        for plane, value in enumerate(_unpack(builder, planes)):
            place = _offset(builder, index, plane * LANES)
            old = load_vector(context, builder, signature.args[0], array, place)
            new = call_llvm(builder, "fma", weight, value, old)
            store_vector(context, builder, signature.args[0], array, place, new)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector, planes), generate


@intrinsic
def add_weighted(typing, sums, weight, planes):
    """Sums[p] + weight planes[p]."""

    def generate(context, builder, signature, arguments):
        sums, weight, planes = arguments
        pairs = zip(_unpack(builder, sums), _unpack(builder, planes), strict=True)
        return cgutils.pack_array(builder, [call_llvm(builder, "fma", weight, new, old) for old, new in pairs])

    return sums(sums, vector, planes), generate


@intrinsic
def add_dot(typing, start, a, b):
    """Start + sum over planes of a[p] b[p]."""

    def generate(context, builder, signature, arguments):
        total, a, b = arguments
        for left, right in zip(_unpack(builder, a), _unpack(builder, b), strict=True):
            total = call_llvm(builder, "fma", left, right, total)
        return total

    return vector(vector, a, b), generate


@intrinsic
def store_lane_sums(typing, array, index, moments, planes):
    """The sum of each vector's lanes, one float after the other.

    A transposing tree: `LANES` vectors become one vector of their sums in log2(LANES) steps.
    """

    def generate(context, builder, signature, arguments):
        array, index, moments, planes = arguments
        vectors = _unpack(builder, moments) + _unpack(builder, planes)
        vectors += [constant([0.0] * LANES)] * (-len(vectors) % LANES)
        for first in range(0, len(vectors), LANES):
            sums = _transposed_sum(builder, vectors[first : first + LANES])
            store_vector(context, builder, signature.args[0], array, _offset(builder, index, first), sums)
        return context.get_dummy_value()

    return types.void(array, types.intp, moments, planes), generate


def _transposed_sum(builder, vectors: list):
    """One vector whose lane i is the sum of the lanes of `vectors[i]`."""
    distance = 1
    while len(vectors) > 1:
        low = [lane - lane // distance % 2 * distance + lane // distance % 2 * LANES for lane in range(LANES)]
        high = [lane + distance for lane in low]
        vectors = [
            builder.fadd(_shuffle(builder, a, b, low), _shuffle(builder, a, b, high))
            for a, b in zip(vectors[::2], vectors[1::2], strict=True)
        ]
        distance *= 2
    return vectors[0]


def _shuffle(builder, a, b, lanes: list[int]):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes))
