"""What the shipped code takes from numba and llvmlite: documented names only, so that a new release breaks nothing."""

import ast
from pathlib import Path

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


def outside(source):
    """All that a module takes from numba and llvmlite and that is not on the list."""
    tree = ast.parse(source)
    names = bound_names(tree)
    found = set(names.values()) - {"numba", "llvmlite", "numba.extending"} - ALLOWED
    for node in ast.walk(tree):
        first, _, rest = ast.unparse(node).partition(".") if isinstance(node, ast.Attribute) else ("", "", "")
        if first in names:
            full = f"{names[first]}.{rest}"
            if not any(full == each or each.startswith(f"{full}.") for each in ALLOWED):
                found.add(full)
        if isinstance(node, ast.FunctionDef | ast.Lambda) and any(each.arg == "builder" for each in node.args.args):
            found |= set(handed_out(node))
    return found | private_attributes(tree) | options(tree, names)


def handed_out(function):
    """Attributes of context, builder and signature in an intrinsic that are not on the list."""
    for node in ast.walk(function):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in IN_INTRINSICS:
            if node.attr not in IN_INTRINSICS[node.value.id]:
                yield f"{node.value.id}.{node.attr}"


def private_attributes(tree):
    """Attributes with a leading underscore of anything but `self`, `cls`, a class of ours or a module's own name."""
    own = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)} | {"self", "cls"}
    return {
        f"{ast.unparse(node.value)}.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__")
        if ast.unparse(node.value).split(".")[0] not in own
    }


def options(tree, names):
    """Options of njit and cfunc that are not on the list; those of `jit.OPTIONS` are in the dictionary of that name."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, _, rest = ast.unparse(node.func).partition(".")
            if f"{names.get(first, '')}{'.' if rest else ''}{rest}" in ("numba.njit", "numba.cfunc"):
                found |= {f"option {each.arg}" for each in node.keywords if each.arg and each.arg not in OPTIONS}
        elif isinstance(node, ast.AnnAssign | ast.Assign) and isinstance(node.value, ast.Dict):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            if getattr(target, "id", "") == "OPTIONS":
                found |= {f"option {key.value}" for key in node.value.keys} - {f"option {each}" for each in OPTIONS}
    return found


def uses_numba(source):
    return bool(bound_names(ast.parse(source)))


def test_shipped_code_uses_documented_names_only():
    sources = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in SHIPPED}
    users = {name: outside(source) for name, source in sources.items() if uses_numba(source)}
    assert {"hapticrender/jit.py", "hapticrender/realtime_kernel.py", "hapticrender/control/kernel.py"} <= set(users)
    assert not {name: found for name, found in users.items() if found}


def test_cached_code_is_named_by_the_state_of_the_sources():
    """numba's cache sees an edit of a function's own file only; parts of a step lie in others."""
    assert close_loop.py_func.__qualname__ == f"close_loop_{digest()}"
    assert error_step.address > 0
    assert error_step.function.__qualname__ == f"error_step_{digest()}"
