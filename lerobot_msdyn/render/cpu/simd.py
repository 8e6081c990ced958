# mypy: disable-error-code="no-untyped-def"
"""Explicit SIMD vectors inside numba: a vector type, a mask type, and the operations that the kernels need.

numba leaves vectorisation to LLVM, which gives up on the compositing loops. Here every operation is an intrinsic
that emits LLVM vector code of `LANES` floats; LLVM maps it to whatever the machine has (one AVX-512 register, one or
two AVX2 registers, two or four of NEON). The lanes of a vector are a block of `BLOCK_WIDTH` x `BLOCK_HEIGHT` pixels.
"""

import operator
from collections.abc import Callable

import numba
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model


def _lanes() -> int:
    """16 with AVX-512; otherwise 8, which keeps the backward pass in fewer registers."""
    if numba.config.CPU_FEATURES is not None:
        return 16 if "+avx512f" in numba.config.CPU_FEATURES else 8
    if numba.config.CPU_NAME not in (None, "host"):
        return 8
    return 16 if binding.get_host_cpu_features().get("avx512f", False) else 8


LANES = _lanes()
BLOCK_WIDTH = 4  # px
BLOCK_HEIGHT = LANES // BLOCK_WIDTH  # px

_FLAGS = ("contract", "nsz", "arcp")
_FLOAT, _INT32 = ir.FloatType(), ir.IntType(32)
VECTOR_IR = ir.VectorType(_FLOAT, LANES)
_INT_VECTOR_IR = ir.VectorType(_INT32, LANES)
_MASK_IR = ir.VectorType(ir.IntType(1), LANES)
_ROW_IR = ir.VectorType(_FLOAT, BLOCK_WIDTH)


class VectorType(types.Type):
    """`LANES` floats."""

    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


class MaskType(types.Type):
    """`LANES` booleans."""

    def __init__(self) -> None:
        super().__init__(name=f"bool x{LANES}")


vector, mask = VectorType(), MaskType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, VECTOR_IR)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _MASK_IR)


def element_pointer(context, builder, array_type, array, index):
    """Address of `array[index]`, without bounds check or wrap-around of negative indices."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def load_vector(context, builder, array_type, array, index):
    """The `LANES` floats from `array[index]` on."""
    pointer = element_pointer(context, builder, array_type, array, index)
    return builder.load(builder.bitcast(pointer, VECTOR_IR.as_pointer()), align=4, typ=VECTOR_IR)


def store_vector(context, builder, array_type, array, index, value):
    """Write `LANES` floats from `array[index]` on."""
    pointer = element_pointer(context, builder, array_type, array, index)
    builder.store(value, builder.bitcast(pointer, VECTOR_IR.as_pointer()), align=4)


def broadcast(builder, scalar):
    """A vector with `scalar` in every lane."""
    undefined = ir.Constant(VECTOR_IR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_INT_VECTOR_IR, [0] * LANES))


def constant(values: list[float]) -> ir.Constant:
    """A vector known at compile time."""
    return ir.Constant(VECTOR_IR, values)


def call_llvm(builder, name: str, *arguments):
    """Call LLVM's vector intrinsic `llvm.<name>`."""
    signature = ir.FunctionType(VECTOR_IR, [VECTOR_IR] * len(arguments))
    function = cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, arguments)


# ---------------------------------------------------------------------------------------------- memory


@intrinsic
def load(typing, array, index):
    """`LANES` floats from `array[index]` on."""

    def generate(context, builder, signature, arguments):
        return load_vector(context, builder, signature.args[0], *arguments)

    return vector(array, types.intp), generate


@intrinsic
def store(typing, array, index, value):
    """Write a vector from `array[index]` on."""

    def generate(context, builder, signature, arguments):
        store_vector(context, builder, signature.args[0], *arguments)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def store_truncated(typing, array, index, value):
    """Write a vector as integers."""

    def generate(context, builder, signature, arguments):
        pointer = element_pointer(context, builder, signature.args[0], *arguments[:2])
        integers = builder.fptosi(arguments[2], _INT_VECTOR_IR)
        builder.store(integers, builder.bitcast(pointer, _INT_VECTOR_IR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def load_block(typing, array, index, stride):
    """A block of an image whose rows are `stride` apart, as one vector."""

    def generate(context, builder, signature, arguments):
        array, index, stride = arguments
        rows = []
        for row in range(BLOCK_HEIGHT):
            start = builder.add(index, builder.mul(stride, ir.Constant(stride.type, row)))
            pointer = element_pointer(context, builder, signature.args[0], array, start)
            rows.append(builder.load(builder.bitcast(pointer, _ROW_IR.as_pointer()), align=4, typ=_ROW_IR))
        while len(rows) > 1:  # join neighbours until one vector holds all rows
            width = 2 * rows[0].type.count
            lanes = ir.Constant(ir.VectorType(_INT32, width), list(range(width)))
            rows = [builder.shuffle_vector(a, b, lanes) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        return rows[0]

    return vector(array, types.intp, types.intp), generate


@intrinsic
def store_block(typing, array, index, stride, value):
    """Inverse of `load_block`."""

    def generate(context, builder, signature, arguments):
        array, index, stride, value = arguments
        for row in range(BLOCK_HEIGHT):
            start = builder.add(index, builder.mul(stride, ir.Constant(stride.type, row)))
            pointer = element_pointer(context, builder, signature.args[0], array, start)
            lanes = [row * BLOCK_WIDTH + column for column in range(BLOCK_WIDTH)]
            picked = ir.Constant(ir.VectorType(_INT32, BLOCK_WIDTH), lanes)
            part = builder.shuffle_vector(value, ir.Constant(VECTOR_IR, ir.Undefined), picked)
            builder.store(part, builder.bitcast(pointer, _ROW_IR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, vector), generate


@intrinsic
def at(typing, array, index):
    """`array[index]` without wrap-around of negative indices."""

    def generate(context, builder, signature, arguments):
        return builder.load(element_pointer(context, builder, signature.args[0], *arguments))

    return array.dtype(array, types.intp), generate


@intrinsic
def prefetch(typing, array, index):
    """Ask for the cache line of `array[index]`, to be read soon."""

    def generate(context, builder, signature, arguments):
        byte = ir.IntType(8).as_pointer()
        pointer = builder.bitcast(element_pointer(context, builder, signature.args[0], *arguments), byte)
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte, _INT32, _INT32, _INT32]), "llvm.prefetch.p0"
        )
        read, keep, data = ir.Constant(_INT32, 0), ir.Constant(_INT32, 3), ir.Constant(_INT32, 1)
        builder.call(function, [pointer, read, keep, data])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@intrinsic
def take_ticket(typing, counter):
    """The first entry before it is incremented, atomically among threads."""

    def generate(context, builder, signature, arguments):
        zero = ir.Constant(ir.IntType(64), 0)
        pointer = element_pointer(context, builder, signature.args[0], arguments[0], zero)
        return builder.atomic_rmw("add", pointer, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), generate


# ---------------------------------------------------------------------------------------------- values


@intrinsic
def splat(typing, scalar):
    """The float in every lane."""

    def generate(context, builder, signature, arguments):
        return broadcast(builder, arguments[0])

    return vector(types.float32), generate


def _constant_vector(values: list[float]) -> Callable:
    @intrinsic
    def build(typing):
        def generate(context, builder, signature, arguments):
            return constant(values)

        return vector(), generate

    return build


zeros = _constant_vector([0.0] * LANES)
lane_index = _constant_vector([float(lane) for lane in range(LANES)])
lane_x = _constant_vector([float(lane % BLOCK_WIDTH) for lane in range(LANES)])
lane_y = _constant_vector([float(lane // BLOCK_WIDTH) for lane in range(LANES)])


# ---------------------------------------------------------------------------------------------- arithmetic


def _arithmetic(python_operator: Callable, instruction: str) -> None:
    """Give vectors the Python operator."""

    @intrinsic
    def apply(typing, a, b):
        def generate(context, builder, signature, arguments):
            return getattr(builder, instruction)(*arguments, flags=_FLAGS)

        return vector(vector, vector), generate

    @overload(python_operator)
    def _on_vectors(a, b):
        if isinstance(a, VectorType) and isinstance(b, VectorType):
            return lambda a, b: apply(a, b)
        return None


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")


@intrinsic
def fma(typing, a, b, c):
    """A b + c, rounded once."""

    def generate(context, builder, signature, arguments):
        return call_llvm(builder, "fma", *arguments)

    return vector(vector, vector, vector), generate


@intrinsic
def fnma(typing, a, b, c):
    """C - a b, rounded once."""

    def generate(context, builder, signature, arguments):
        return call_llvm(builder, "fma", builder.fneg(arguments[0]), arguments[1], arguments[2])

    return vector(vector, vector, vector), generate


def _rounding(name: str) -> Callable:
    @intrinsic
    def apply(typing, a):
        def generate(context, builder, signature, arguments):
            return call_llvm(builder, name, *arguments)

        return vector(vector), generate

    return apply


root, floor, ceil = _rounding("sqrt"), _rounding("floor"), _rounding("ceil")


def _choice(relation: str) -> Callable:
    @intrinsic
    def apply(typing, a, b):
        def generate(context, builder, signature, arguments):
            return builder.select(builder.fcmp_ordered(relation, *arguments), *arguments)

        return vector(vector, vector), generate

    return apply


smaller, larger = _choice("<"), _choice(">")  # of two vectors; the second where either is NaN


# exp2 on [-0.5, 0.5], fitted for least relative error (7.5e-8 before rounding)
_EXP2 = (1.00000007, 0.69314697, 0.2402212, 0.05550714, 0.00967554, 0.00132762)
_LEAST_EXPONENT = -126.0


@intrinsic
def exp2(typing, a):
    """2 to the power of each lane, relative error below 2e-7; 2^-126 below that."""

    def generate(context, builder, signature, arguments):
        floor_of_range = constant([_LEAST_EXPONENT] * LANES)
        power = builder.select(builder.fcmp_ordered(">", arguments[0], floor_of_range), arguments[0], floor_of_range)
        whole = call_llvm(builder, "rint", power)
        fraction = builder.fsub(power, whole)
        result = constant([_EXP2[-1]] * LANES)
        for coefficient in reversed(_EXP2[:-1]):
            result = call_llvm(builder, "fma", result, fraction, constant([coefficient] * LANES))
        # 2^whole enters by adding to the exponent bits
        shift = builder.shl(builder.fptosi(whole, _INT_VECTOR_IR), ir.Constant(_INT_VECTOR_IR, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(result, _INT_VECTOR_IR), shift), VECTOR_IR)

    return vector(vector), generate


# ---------------------------------------------------------------------------------------------- masks


def _comparison(relation: str) -> Callable:
    @intrinsic
    def apply(typing, a, b):
        def generate(context, builder, signature, arguments):
            return builder.fcmp_ordered(relation, *arguments)

        return mask(vector, vector), generate

    return apply


greater, greater_equal, less = _comparison(">"), _comparison(">="), _comparison("<")


@intrinsic
def both(typing, a, b):
    """Lanes set in both."""

    def generate(context, builder, signature, arguments):
        return builder.and_(*arguments)

    return mask(mask, mask), generate


@intrinsic
def any_lane(typing, a):
    """Whether a lane is set."""

    def generate(context, builder, signature, arguments):
        bits = builder.bitcast(arguments[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), generate


@intrinsic
def select(typing, condition, a, b):
    """Lanes of a where set, of b elsewhere."""

    def generate(context, builder, signature, arguments):
        return builder.select(*arguments)

    return vector(mask, vector, vector), generate


@intrinsic
def set_sign(typing, a, where):
    """-|a| in the lanes that are set.

    By bit operations: LLVM would turn storing a `select` of what was just loaded into a masked store, which is slow.
    """

    def generate(context, builder, signature, arguments):
        chosen = builder.sext(arguments[1], _INT_VECTOR_IR)
        sign = builder.and_(chosen, ir.Constant(_INT_VECTOR_IR, [-(2**31)] * LANES))
        return builder.bitcast(builder.or_(builder.bitcast(arguments[0], _INT_VECTOR_IR), sign), VECTOR_IR)

    return vector(vector, mask), generate


@intrinsic
def magnitude(typing, a):
    """|a|."""

    def generate(context, builder, signature, arguments):
        return call_llvm(builder, "fabs", *arguments)

    return vector(vector), generate
