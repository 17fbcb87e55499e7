"""What the shipped code takes from numba and llvmlite: documented names only, so that a new release breaks nothing."""

import ast
from pathlib import Path

from hapticrender import jit
from hapticrender.control.kernel import error_step
from hapticrender.jit import close_loop, digest

ROOT = Path(__file__).resolve().parent.parent
SHIPPED = sorted(path for folder in ("hapticrender", "renderers", "drivers") for path in (ROOT / folder).rglob("*.py"))
PACKAGES = ("numba", "llvmlite")
TYPES = "int32 int64 uint32 uint64 float32 float64 complex128 boolean Float Integer Type CPointer".split()
EXTENSION = "intrinsic lower_builtin models models.PrimitiveModel register_model type_callable".split()
IR = "Constant DoubleType Function FunctionType IntType LiteralStructType PointerType Undefined VectorType".split()
ALLOWED = {  # numba's user manual and extension manual, llvmlite's manual of its IR layer
    *("numba.njit", "numba.cfunc", "numba.carray", "numba.from_dtype", "numba.types"),
    *(f"numba.extending.{name}" for name in EXTENSION),
    *(f"numba.types.{name}" for name in TYPES),
    *("llvmlite.ir", *(f"llvmlite.ir.{name}" for name in IR)),
}
IN_INTRINSICS = {  # attributes of what numba hands to a code generator, and of its types
    "context": {"get_value_type"},
    "builder": set(
        "inttoptr add mul call atomic_rmw extract_value insert_value extract_element insert_element shuffle_vector "
        "sitofp fadd fsub fmul fdiv fma fneg fcmp_ordered icmp_unsigned select bitcast gep load store module".split()
    ),
    "signature": {"args", "return_type"},
    "typingctx": set(),
}
OPTIONS = {"cache", "error_model", "fastmath", "nogil", "_nrt"}  # of njit and cfunc


def bound_names(tree):
    """Name in a module -> dotted name of what it stands for in numba or llvmlite."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                package = alias.name.split(".")[0]
                if package in PACKAGES:
                    names |= {alias.name: alias.name, alias.asname or package: alias.name if alias.asname else package}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES and not node.level:
            names.update({alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names})
    return names


def outside(tree, names):
    """All that a module takes from numba and llvmlite and that is not on the list."""
    found = set(names.values()) - {"numba", "llvmlite", "numba.extending"} - ALLOWED
    for node in ast.walk(tree):
        first, _, rest = ast.unparse(node).partition(".") if isinstance(node, ast.Attribute) else ("", "", "")
        full = f"{names[first]}.{rest}" if first in names else ""
        if full and not any(full == each or each.startswith(f"{full}.") for each in ALLOWED):
            found.add(full)
        if isinstance(node, ast.FunctionDef | ast.Lambda) and any(each.arg == "builder" for each in node.args.args):
            handed = [each for each in ast.walk(node) if isinstance(each, ast.Attribute)]
            owners = [(ast.unparse(each.value), each.attr) for each in handed]
            found |= {f"{owner}.{name}" for owner, name in owners if name not in IN_INTRINSICS.get(owner, {name})}
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("numba.njit", "numba.cfunc", "njit", "cfunc"):
            found |= {f"option {each.arg}" for each in node.keywords if each.arg and each.arg not in OPTIONS}
    return found | private_attributes(tree)


def private_attributes(tree):
    """Attributes with a leading underscore of anything but `self`, `cls`, a class of ours or a module's own name."""
    own = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)} | {"self", "cls"}
    return {
        f"{ast.unparse(node.value)}.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__")
        if ast.unparse(node.value).split(".")[0] not in own
    }


def test_shipped_code_uses_documented_names_only():
    trees = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in SHIPPED}
    users = {name: outside(tree, names) for name, tree in trees.items() if (names := bound_names(tree))}
    assert {"hapticrender/jit.py", "hapticrender/realtime_kernel.py", "hapticrender/control/kernel.py"} <= set(users)
    assert not {name: found for name, found in users.items() if found}
    assert set(jit.OPTIONS) <= OPTIONS


def test_cached_code_is_named_by_the_state_of_the_sources():
    """numba's cache sees an edit of a function's own file only; parts of a step lie in others."""
    assert close_loop.py_func.__qualname__ == f"close_loop_{digest()}"
    assert error_step.address > 0
    assert error_step.function.__qualname__ == f"error_step_{digest()}"
