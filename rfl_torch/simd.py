"""Sixteen numbers as one value in numba code: a loop over tiles that stays in registers.

The autovectoriser keeps no accumulator in a register across an inner loop of unknown length, and
gives up where numba's int32 arithmetic widens to int64. With these types the same loop reads as
before, one tile of `LANES` cells at a time:

    total = broadcast(np.float32(0.0))
    for o in range(num_terms):
        total += load(a, o * stride + c) * load(b, o * stride + c)
    store(total, out, c)

The compiler splits a tile over whatever registers the machine has. Indices count elements from the
start of a C-contiguous array, whatever its shape, and are not checked.
"""

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 16

_LINE = 64
"""Bytes of a cache line: a tile that lies across two of them takes two reads."""


def aligned_empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Uninitialised array that starts on a cache line."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    buffer = np.empty(size + _LINE, np.uint8)
    start = -buffer.ctypes.data % _LINE
    return buffer[start : start + size].view(dtype).reshape(shape)


def aligned_full(shape: tuple[int, ...], value: float, dtype: Any) -> np.ndarray:
    """Array of one value that starts on a cache line."""
    array = aligned_empty(shape, dtype)
    array.fill(value)
    return array


@njit
def aligned_row(size, zero):  # type: ignore[no-untyped-def]
    """Row of `size` copies of `zero` that starts on a cache line, for use in compiled code."""
    row = np.full(size + _LINE, zero)
    start = (-row.ctypes.data % _LINE) // row.itemsize
    return row[start : start + size]


class Vector(types.Type):
    """The numba type of `LANES` numbers of one scalar type."""

    def __init__(self, dtype: types.Type) -> None:
        self.dtype = dtype
        super().__init__(f"Vector({dtype})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: Vector) -> None:
        element = manager.lookup(vector.dtype).get_value_type()
        super().__init__(manager, vector, ir.VectorType(element, LANES))


class Registers(types.Type):
    """The numba type of a few vectors of one scalar type, see `registers`."""

    def __init__(self, dtype: types.Type, count: int) -> None:
        self.dtype, self.count = dtype, count
        super().__init__(f"Registers({dtype}, {count})")


@register_model(Registers)
class _RegistersModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kept: Registers) -> None:
        element = manager.lookup(kept.dtype).get_value_type()
        tiles = ir.ArrayType(ir.VectorType(element, LANES), kept.count)
        super().__init__(manager, kept, tiles.as_pointer())


_FLAGS = ("contract", "nsz", "arcp")


def _lanes(element: ir.Type) -> ir.VectorType:
    return ir.VectorType(element, LANES)


def _is_float(vector: types.Type) -> bool:
    return isinstance(vector.dtype, types.Float)


def _call(builder: Any, name: str, result: ir.Type, *args: Any, flags: tuple[str, ...] = ()) -> Any:
    """Call an LLVM intrinsic whose name ends in the vector's type."""
    kind = ir.FunctionType(result, [arg.type for arg in args])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, args, fastmath=flags)


def _suffix(vector: Vector) -> str:
    letter = "f" if _is_float(vector) else "i"
    return f"v{LANES}{letter}{vector.dtype.bitwidth}"


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Point at LANES elements of an array, from the index on."""
    data = context.make_array(array_type)(context, builder, array).data
    pointer = builder.gep(data, [index])
    return builder.bitcast(pointer, _lanes(data.type.pointee).as_pointer())


def _align(array_type: Any) -> int:
    return array_type.dtype.bitwidth // 8


@intrinsic
def load(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Read the elements index, index + 1, ... of a C-contiguous array."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _address(context, builder, signature.args[0], *args)
        return builder.load(pointer, align=_align(signature.args[0]))

    return Vector(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing_context, value, array, index):  # type: ignore[no-untyped-def]
    """Write a vector over the elements index, index + 1, ... of a C-contiguous array."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        pointer = _address(context, builder, signature.args[1], *args[1:])
        builder.store(args[0], pointer, align=_align(signature.args[1]))
        return context.get_dummy_value()

    return types.void(value, array, types.intp), generate


@intrinsic
def broadcast(typing_context, value):  # type: ignore[no-untyped-def]
    """The same number in every lane."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = _lanes(args[0].type)
        one = builder.insert_element(ir.Constant(kind, ir.Undefined), args[0], ir.IntType(32)(0))
        order = ir.Constant(_lanes(ir.IntType(32)), [0] * LANES)
        return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), order)

    return Vector(value)(value), generate


def _binary(float_name: str, int_name: str) -> Any:
    """An elementwise operation of two vectors of one type."""

    @intrinsic
    def operation(typing_context, a, b):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            if _is_float(a):
                return getattr(builder, float_name)(*args, flags=_FLAGS)
            return getattr(builder, int_name)(*args)

        return a(a, a), generate

    return operation


_add, _sub, _mul = _binary("fadd", "add"), _binary("fsub", "sub"), _binary("fmul", "mul")
_div, _shl, _shr = _binary("fdiv", "sdiv"), _binary("", "shl"), _binary("", "ashr")
_and, _or = _binary("", "and_"), _binary("", "or_")


def _overload(symbol: Any, operation: Any) -> None:
    @overload(symbol)
    def choose(a, b):  # type: ignore[no-untyped-def]
        if isinstance(a, Vector) and isinstance(b, Vector):
            return lambda a, b: operation(a, b)
        if isinstance(a, Vector) and a.dtype == b:
            return lambda a, b: operation(a, broadcast(b))
        if isinstance(b, Vector) and b.dtype == a:
            return lambda a, b: operation(broadcast(a), b)
        return None


for _symbol, _operation in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _div),
    (operator.lshift, _shl),
    (operator.rshift, _shr),
    (operator.and_, _and),
    (operator.or_, _or),
    (operator.iadd, _add),
    (operator.imul, _mul),
):
    _overload(_symbol, _operation)


@intrinsic
def greater(typing_context, a, b):  # type: ignore[no-untyped-def]
    """Whether a > b, lane by lane; False for NaN."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        if _is_float(a):
            return builder.fcmp_ordered(">", *args)
        return builder.icmp_signed(">", *args)

    return Vector(types.boolean)(a, a), generate


@intrinsic
def where(typing_context, mask, a, b):  # type: ignore[no-untyped-def]
    """Take a where the mask is set, else b."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.select(*args)

    return a(mask, a, a), generate


@intrinsic
def maximum(typing_context, a, b):  # type: ignore[no-untyped-def]
    """The larger of two vectors, lane by lane; b if a is NaN."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        if _is_float(a):
            return builder.select(builder.fcmp_ordered(">", *args), *args)
        return builder.select(builder.icmp_signed(">", *args), *args)

    return a(a, a), generate


@intrinsic
def largest(typing_context, a):  # type: ignore[no-untyped-def]
    """The largest of the lanes, none of which may be NaN."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        name = "fmax" if _is_float(a) else "smax"
        flags = ("nnan", "nsz") if _is_float(a) else ()
        element = args[0].type.element
        return _call(
            builder, f"llvm.vector.reduce.{name}.{_suffix(a)}", element, args[0], flags=flags
        )

    return a.dtype(a), generate


@intrinsic
def add_lanes(typing_context, a):  # type: ignore[no-untyped-def]
    """Sum the lanes, pairwise."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        element = args[0].type.element
        name = f"llvm.vector.reduce.fadd.{_suffix(a)}"
        zero = ir.Constant(element, -0.0)
        return _call(builder, name, element, zero, args[0], flags=("reassoc",))

    return a.dtype(a), generate


@intrinsic
def round_down(typing_context, a):  # type: ignore[no-untyped-def]
    """The floor, still as floats."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return _call(builder, f"llvm.floor.{_suffix(a)}", args[0].type, args[0])

    return a(a), generate


def _conversion(source: types.Type, target: types.Type, name: str) -> Any:
    """A cast of every lane from one scalar type to another."""

    @intrinsic
    def cast(typing_context, a):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return getattr(builder, name)(args[0], _lanes(context.get_value_type(target)))

        return (Vector(target)(a), generate) if a == Vector(source) else None

    return cast


narrow = _conversion(types.float64, types.float32, "fptrunc")
widen = _conversion(types.float32, types.float64, "fpext")
to_int = _conversion(types.float64, types.int32, "fptosi")
as_bits = _conversion(types.float32, types.int32, "bitcast")
as_float = _conversion(types.int32, types.float32, "bitcast")


@intrinsic(prefer_literal=True)
def registers(typing_context, count, like):  # type: ignore[no-untyped-def]
    """Room for `count` vectors of the type of `like`, uninitialised.

    They stay in registers where every index is a constant: in loops over a constant `range`, which
    the compiler unrolls. Else they lie on the stack.
    """
    kind = Registers(like, count.literal_value)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return cgutils.alloca_once(builder, context.get_value_type(kind).pointee)

    return kind(count, like), generate


@intrinsic
def put(typing_context, kept, index, value):  # type: ignore[no-untyped-def]
    """Write one of the vectors that `registers` holds."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], builder.gep(args[0], [ir.IntType(64)(0), args[1]]))
        return context.get_dummy_value()

    return types.void(kept, types.intp, value), generate


@intrinsic
def get(typing_context, kept, index):  # type: ignore[no-untyped-def]
    """Read one of the vectors that `registers` holds."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.load(builder.gep(args[0], [ir.IntType(64)(0), args[1]]))

    return Vector(kept.dtype)(kept, types.intp), generate


@intrinsic
def load_one(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Read the one element at `index`, unchecked."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load(builder.gep(data, [args[1]]))

    return array.dtype(array, types.intp), generate


@intrinsic
def any_lane(typing_context, mask):  # type: ignore[no-untyped-def]
    """Whether the mask is set in any lane."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.IntType(LANES)(0))

    return types.boolean(mask), generate


@intrinsic
def prefetch(typing_context, array, index):  # type: ignore[no-untyped-def]
    """Have a tile brought into the cache; an index outside of the array does nothing."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        word = ir.IntType(32)
        pointer = builder.bitcast(builder.gep(data, [args[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, word, word, word])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate
