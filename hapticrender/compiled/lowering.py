"""A kernel's way from numba's code to LLVM's: loops and entries of arrays in as few instructions as they need.

Numba's own code for them also looks after what kernels do not have: exceptions, references, arrays of any layout.
All of that is gone in the end, but it is written, read and optimised before a first sample.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir as llvm
from numba.core import cgutils, ir, types
from numba.core.datamodel import default_manager
from numba.core.lowering import Lower

ARRAY = default_manager[types.Array(types.float64, 1, "C")]
DATA, SHAPE = (ARRAY.get_field_position(name) for name in ("data", "shape"))


class KernelLower(Lower):
    """Numba's step to LLVM's code for what kernels consist of: nothing is counted, so nothing has to be given back."""

    def lower_block(self, block: Any) -> None:
        """Write the code of a block."""
        for each in block.body:
            self.loc = each.loc
            self.lower_inst(each)

    def lower_inst(self, inst: Any) -> None:
        """Write the code of a statement."""
        if isinstance(inst, ir.Assign):
            name = inst.target.name
            self.storevar(self.lower_assign(self.typeof(name), inst), name)
        elif not (isinstance(inst, ir.SetItem) and self.put_entry(inst)):
            super().lower_inst(inst)

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Write the code of an expression; what a kernel's loops count through is a range."""
        if expr.op in ("getiter", "iternext", "pair_first", "pair_second"):
            kind, value = self.typeof(expr.value.name), self.loadvar(expr.value.name)
            if isinstance(kind, types.RangeType):
                return begun(self.builder, value, self.context.get_value_type(resty))
            if isinstance(kind, types.RangeIteratorType):
                return next_of(self.builder, value, self.context.get_value_type(resty))
            if isinstance(kind, types.Pair):
                return self.builder.extract_value(value, int(expr.op == "pair_second"))
        return super().lower_expr(resty, expr)

    def put_entry(self, inst: Any) -> bool:
        """Write the code that puts a number into an array; nothing where it is more than one."""
        kind, at, value = (self.typeof(each.name) for each in (inst.target, inst.index, inst.value))
        if not is_entry(kind, at):
            return False
        place = entry(self.builder, kind, self.loadvar(inst.target.name), at, self.loadvar(inst.index.name))
        exact = self.context.cast(self.builder, self.loadvar(inst.value.name), value, kind.dtype)
        self.context.pack_value(self.builder, kind.dtype, exact, place)
        return True

    def lower_call(self, resty: Any, expr: Any) -> Any:
        """Write the code of a call."""
        kind, signature = self.typeof(expr.func.name), self.fndesc.calltypes[expr]
        args = self.fold_call_args(kind, signature, expr.args, expr.vararg, expr.kws)
        if getattr(kind, "typing_key", None) is range:
            return span(self.builder, args, self.context.get_value_type(resty))
        if signature.recvr:
            args = [self.loadvar(expr.func.name), *args]
        found = self.context.get_function(kind, signature)(self.builder, args, self.loc)
        if found is None:
            found = self.context.get_dummy_value()
        return self.context.cast(self.builder, found, signature.return_type, resty)

    def lower_binop(self, resty: Any, expr: Any, op: Any) -> Any:
        """Write the code of an operator."""
        return self.operated(op, self.fndesc.calltypes[expr], (expr.lhs, expr.rhs), resty)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Write the code that takes an item."""
        kind, at = self.typeof(value.name), self.typeof(index.name)
        if is_entry(kind, at):
            place = entry(self.builder, kind, self.loadvar(value.name), at, self.loadvar(index.name))
            return self.context.unpack_value(self.builder, kind.dtype, place)
        return self.operated(operator.getitem, signature, (value, index), resty)

    def operated(self, op: Any, signature: Any, operands: Any, resty: Any) -> Any:
        """Return what an operator makes of its operands."""
        values = [self._cast_var(each, kind) for each, kind in zip(operands, signature.args, strict=True)]
        typing = self.context.typing_context
        known = typing.resolve_value_type(op)
        exact = typing.resolve_function_type(known, signature.args, {})
        found = self.context.get_function(known, exact)(self.builder, values)
        return self.context.cast(self.builder, found, signature.return_type, resty)

    def storevar(self, value: Any, name: str, argidx: Any = None) -> None:
        """Keep a value."""
        self._alloca_var(name, self.typeof(name))
        if name in self._singly_assigned_vars:
            self._blk_local_varmap[name] = value
        else:
            self.builder.store(value, self.getvar(name))

    def alloca_lltype(self, name: str, lltype: Any, datamodel: Any = None) -> Any:
        """Make room for a variable."""
        return cgutils.alloca_once(self.builder, lltype, name=name)


def is_entry(kind: Any, at: Any) -> bool:
    """Whether an index of this type finds a single number in an array of this type."""
    indices = tuple(at) if isinstance(at, types.BaseTuple) else (at,)  # type: ignore[arg-type]
    plain = isinstance(kind, types.Array) and kind.layout == "C" and kind.ndim == len(indices)
    return plain and all(types.unliteral(each) == types.intp for each in indices)


def data_of(builder: Any, array: Any) -> Any:
    """Pointer to an array's numbers."""
    return builder.extract_value(array, DATA)


def length_of(builder: Any, array: Any, axis: int) -> Any:
    """Length of an array along an axis."""
    return builder.extract_value(array, [SHAPE, axis])


def flat(builder: Any, array: Any, where: Any) -> Any:
    """Place of array[where], one axis after another, counted in what the axes left out hold."""
    place = where[0]
    for axis, index in enumerate(where[1:], 1):
        place = builder.add(builder.mul(place, length_of(builder, array, axis)), index)
    return place


def entry(builder: Any, kind: Any, array: Any, at: Any, index: Any) -> Any:
    """Pointer to a number in an array; indices below 0 count from its end."""
    where = cgutils.unpack_tuple(builder, index, kind.ndim) if isinstance(at, types.BaseTuple) else [index]
    for axis, one in enumerate(where):
        if not isinstance(one, llvm.Constant) or one.constant < 0:
            below = builder.icmp_signed("<", one, one.type(0))
            where[axis] = builder.select(below, builder.add(one, length_of(builder, array, axis)), one)
    return builder.gep(data_of(builder, array), [flat(builder, array, where)])


def span(builder: Any, args: Any, kind: Any) -> Any:
    """Range from its one to three numbers."""
    whole = kind.elements[0]
    start, stop, step = (whole(0), *args, whole(1)) if len(args) == 1 else (*args, whole(1))[:3]
    return filled(builder, kind, (start, stop, step))


def filled(builder: Any, kind: Any, values: Any) -> Any:
    """Structure that starts with these values."""
    made = llvm.Constant(kind, llvm.Undefined)
    for i, value in enumerate(values):
        made = builder.insert_value(made, value, i)
    return made


def begun(builder: Any, numbers: Any, kind: Any) -> Any:
    """Iterator over a range: where the next number is kept, and end and step."""
    start, stop, step = (builder.extract_value(numbers, i) for i in range(3))
    place = cgutils.alloca_once(builder, start.type)
    builder.store(start, place)
    return filled(builder, kind, (place, stop, step))


def next_of(builder: Any, iterator: Any, kind: Any) -> Any:
    """Next number of a range, and whether there is one."""
    place, stop, step = (builder.extract_value(iterator, i) for i in range(3))
    number = builder.load(place)
    up, down = builder.icmp_signed("<", number, stop), builder.icmp_signed(">", number, stop)
    more = builder.select(builder.icmp_signed(">", step, step.type(0)), up, down)
    builder.store(builder.add(number, step, flags=["nsw"]), place)
    return filled(builder, kind, (number, more))
