"""Blocks of floats that a kernel holds in the processor's registers.

A block is a few rows of an image, of a few floats each. Sums in an array are loaded and stored for
each term that a loop adds; sums in blocks stay in registers. In kernels, blocks and numbers can be
added, subtracted, multiplied and divided, element by element.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.codegen import get_host_cpu_features
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

ROWS, LANES = (5, 16) if "+avx512f" in get_host_cpu_features() else (3, 8)
"""Of a block: four of them fill the registers, 32 of 16 floats or 16 of 8, but for a few."""
_ROW = ir.VectorType(ir.FloatType(), LANES)
_FLAGS = ("contract",)  # a product and a sum in one instruction, where there is one


class _Block(types.Type):
    """The type of a block, of which there is one; numbers are converted to it."""

    def can_convert_from(self, _: Any, other: Any) -> Conversion | None:
        return Conversion.safe if isinstance(other, types.Float) else None


_BLOCK = _Block("Block")


@register_model(_Block)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.ArrayType(_ROW, ROWS))


@lower_cast(types.float32, _BLOCK)
@lower_cast(types.float64, _BLOCK)
def _fill(context: Any, builder: Any, kind: Any, _: Any, value: Any) -> Any:
    """A block of one number."""
    number = context.cast(builder, value, kind, types.float32)
    row = ir.Constant(_ROW, ir.Undefined)
    for lane in range(LANES):
        row = builder.insert_element(row, number, ir.IntType(32)(lane))
    return _join(builder, [row] * ROWS)


def _define(operation: Any, instruction: Callable[[Any, Any, Any], Any]) -> None:
    """Define an operation of two blocks, or of a block and a number."""

    @infer_global(operation)
    class _Signature(AbstractTemplate):
        def generic(self, arguments: Any, _: Any) -> Any:
            return _BLOCK(_BLOCK, _BLOCK) if _BLOCK in arguments else None

    @lower_builtin(operation, _BLOCK, _BLOCK)
    def build(context: Any, builder: Any, signature: Any, blocks: Any) -> Any:
        pairs = zip(*(_split(builder, block) for block in blocks), strict=True)
        return _join(builder, [instruction(builder, *pair) for pair in pairs])


for _sum in (operator.add, operator.iadd):
    _define(_sum, lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
for _difference in (operator.sub, operator.isub):
    _define(_difference, lambda builder, a, b: builder.fsub(a, b, flags=_FLAGS))
_define(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=_FLAGS))
_define(operator.truediv, lambda builder, a, b: builder.fdiv(a, b, flags=_FLAGS))
_define(max, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))


def _intrinsic(define: Callable[..., Any]) -> Any:
    return intrinsic(define)


@_intrinsic
def fill_block(_: Any, number: Any) -> Any:
    """A block of one number."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return arguments[0]

    return _BLOCK(_BLOCK), build


@_intrinsic
def load_block(_: Any, values: Any, at: Any, stride: Any) -> Any:
    """The block whose rows begin at the elements at, at + stride, ... of a flat array."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers = _point_to_rows(context, builder, values, arguments)
        return _join(builder, [builder.load(pointer, align=4) for pointer in pointers])

    return _BLOCK(values, types.intp, types.intp), build


@_intrinsic
def store_block(_: Any, values: Any, at: Any, stride: Any, block: Any) -> Any:
    """Store a block where :func:`load_block` would load it."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers = _point_to_rows(context, builder, values, arguments)
        for row, pointer in zip(_split(builder, arguments[3]), pointers, strict=True):
            builder.store(row, pointer, align=4)
        return context.get_dummy_value()

    return types.void(values, types.intp, types.intp, _BLOCK), build


def _point_to_rows(context: Any, builder: Any, kind: Any, arguments: Any) -> list[Any]:
    """Pointers to a block's rows; arguments: an array, at, stride."""
    array = context.make_array(kind)(context, builder, arguments[0])
    at, pointers = arguments[1], []
    for _ in range(ROWS):
        pointers.append(builder.bitcast(builder.gep(array.data, [at]), _ROW.as_pointer()))
        at = builder.add(at, arguments[2])
    return pointers


def _split(builder: Any, block: Any) -> list[Any]:
    return [builder.extract_value(block, row) for row in range(ROWS)]


def _join(builder: Any, rows: list[Any]) -> Any:
    block = ir.Constant(ir.ArrayType(_ROW, ROWS), ir.Undefined)
    for index, row in enumerate(rows):
        block = builder.insert_value(block, row, index)
    return block
