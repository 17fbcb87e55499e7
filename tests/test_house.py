"""House rules: what is shipped, who imports whom, what is taken from numba; docstrings and README are true."""

import ast
import doctest
import graphlib
import importlib
import inspect
import pkgutil
import re
import sys
import tomllib
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import benchmarks
import hapticrender
from hapticrender import jit
from hapticrender.control.kernel import error_step
from hapticrender.jit import close_loop, digest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = ("hapticrender", "renderers", "drivers")


def shipped_files():
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "hapticrender" else ("hapticrender", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in shipped_files() if path.name != "__main__.py"}


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def test_packages_on_disk_are_the_packages_shipped():
    on_disk = {module_name(path) for path in shipped_files() if path.name == "__init__.py"}
    assert sorted(on_disk) == sorted(PROJECT["tool"]["setuptools"]["packages"])


def test_every_package_comes_from_where_the_map_says():
    beside = PROJECT["tool"]["setuptools"]["package-dir"]
    assert beside == {f"hapticrender.{folder}": folder for folder in FOLDERS[1:]}
    for name, path in MODULES.items():
        assert Path(importlib.import_module(name).__file__).resolve() == path


def test_entry_points_resolve():
    declared = PROJECT["project"]["entry-points"] | {"console_scripts": PROJECT["project"]["scripts"]}
    for group, points in declared.items():
        installed = {point.name: point for point in entry_points(group=group)}
        for name, target in points.items():
            assert installed[name].value == target, f"{group}: {name}: install the package anew"
            assert callable(installed[name].load())


def test_the_package_shows_its_public_names_and_nothing_else():
    packages = {name.split(".")[1] for name in MODULES if "." in name}
    public = {name for name in dir(hapticrender) if not name.startswith("_")}
    assert set(hapticrender.__all__) <= public <= set(hapticrender.__all__) | packages
    assert not [name for name in ("Any", "TYPE_CHECKING", "annotations") if hasattr(hapticrender, name)]


def test_sweep_is_a_module_before_and_after_its_import(monkeypatch):
    monkeypatch.delitem(sys.modules, "hapticrender.sweep", raising=False)
    monkeypatch.delattr(hapticrender, "sweep", raising=False)
    before = hapticrender.sweep
    assert importlib.import_module("hapticrender.sweep") is before is hapticrender.sweep
    assert before.sweep


def test_type_checkers_see_every_public_name():
    (block,) = [node for node in tree_of(MODULES["hapticrender"]).body if is_for_types_only(node)]
    assert sorted(alias.asname for node in block.body for alias in node.names) == hapticrender.__all__


GROUND = {
    f"hapticrender.{name}"
    for name in ("protocols", "errors", "bands", "checks", "formatting", "jit", "vectors", "mathx", "process_signals")
}
GROUND |= {f"hapticrender.{name}" for name in ("defaults", "devices", "driver_checks", "second_core")}
DEVICES = {"touch", "control", "plants"}
MAY_IMPORT = {  # package: the others that it may import; renderers and drivers are found by their entry points
    "ground": set(),
    "touch": set(),
    "control": set(),
    "plants": {"control", "touch"},
    "renderers": DEVICES | {"drivers"},
    "drivers": {"plants", "touch"},
    "results": {"touch", "core"},
    "analysis": DEVICES | {"results"},  # a recording, its pictures and pages, but nothing that plays
    "core": DEVICES | {"analysis", "results"},
    "top": {*DEVICES, "analysis", "core", "results"},
}
RESULTS = {"recordings", "report"}
TOP = {f"hapticrender.{name}" for name in ("cli", "verbs", "validate")}


def layer_of(name):
    parts = name.split(".")
    if name in GROUND:
        return "ground"
    if name in TOP:
        return "top"
    if len(parts) > 1 and parts[1] in RESULTS:
        return "results"
    return parts[1] if len(parts) > 1 and parts[1] in MAY_IMPORT else "core"


def is_for_types_only(node):
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "_typing.TYPE_CHECKING")


def imports(node, at_once=False):
    """Names of our modules that a tree imports at run time, anywhere or only `at_once`, outside functions."""
    for child in ast.iter_child_nodes(node):
        if is_for_types_only(child) or (at_once and isinstance(child, ast.FunctionDef)):
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names if alias.name.split(".")[0] in FOLDERS)
        elif isinstance(child, ast.ImportFrom):
            assert not child.level, "an import relative to its package"
            if child.module.split(".")[0] in FOLDERS:
                names = (f"{child.module}.{alias.name}" for alias in child.names)
                yield from (name if name in MODULES else child.module for name in names)
        else:
            yield from imports(child, at_once)


@pytest.mark.parametrize("name", sorted(set(MODULES) - {"hapticrender"}))
def test_imports_run_downwards(name):
    layer = layer_of(name)
    for found in imports(tree_of(MODULES[name])):
        assert found.startswith("hapticrender"), f"{name} imports {found} by its short name: a second module object"
        assert layer_of(found) in MAY_IMPORT[layer] | {layer, "ground"}, f"{name} ({layer}) imports {found}"


def test_imports_have_no_circles():
    """Of modules, when they are imported; what a function imports when it is called may lie above."""
    graph = {name: set(imports(tree_of(path), at_once=True)) - {name, "hapticrender"} for name, path in MODULES.items()}
    assert len(list(graphlib.TopologicalSorter(graph).static_order())) >= len(graph)  # raises CycleError


def members(owner, module):
    """Public functions and classes that `module` defines, and the public methods of those classes."""
    for name, value in vars(owner).items():
        value = getattr(value, "py_func", value)  # a kernel's own function
        value = getattr(value, "__func__", value)
        if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(value):
            yield value
        elif inspect.isclass(value):
            yield value
            yield from members(value, module)


def documented(value):
    """Names in the numpydoc section Parameters, None where there is no such section."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\S[^\n]*\n-{3,}|\Z)", inspect.getdoc(value) or "", re.M | re.S)
    if section is None:
        return None
    heads = re.findall(r"^(\*{0,2}\w.*?)(?: : .*)?$", section.group(1), re.M)
    return [name.strip() for head in heads for name in head.split(",")]


def parameters(value):
    """All names of the signature, and those of them that have a place in it."""
    found = [p for p in inspect.signature(value).parameters.values() if p.name not in ("self", "cls")]
    stars = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    names = [stars.get(p.kind, "") + p.name for p in found]
    return names, [name for name, p in zip(names, found, strict=True) if p.kind != inspect.Parameter.KEYWORD_ONLY]


@pytest.mark.parametrize("name", MODULES)
def test_documented_parameters_are_the_signatures(name):
    module = importlib.import_module(name)
    for value in members(module, module):
        section = documented(value)
        if section is not None:
            names, in_order = parameters(value)
            above = {each for base in getattr(value, "__mro__", ())[1:] for each in documented(base) or ()}
            if above.isdisjoint(section):  # what a base class says of its parameters need not be said again
                names, in_order = ([each for each in listed if each not in above] for listed in (names, in_order))
            assert sorted(section) == sorted(names), f"{name}.{value.__qualname__}"
            assert [each for each in section if each in in_order] == in_order, f"{name}.{value.__qualname__}"


@pytest.mark.parametrize("name", MODULES)
def test_doctests_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    complaints = []
    for test in doctest.DocTestFinder(exclude_empty=True).find(module, name):
        runner.run(test, out=complaints.append)
    assert not runner.failures, "".join(complaints)


def blocks(page, language):
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.fixture
def run_python(tmp_path, monkeypatch, empty_pictures):
    """Function that runs the Python of a page in one namespace, which it returns."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)

    def run(page):
        names = {"__name__": "page"}
        assert blocks(page, "python")
        for number, block in enumerate(blocks(page, "python")):
            exec(compile(block, f"{page}, Python block {number}", "exec"), names)
        return names

    return run


def test_python_in_the_readme_runs(run_python, monkeypatch, capsys):
    """The player within `sleep`, so that no busy machine makes its finger late: 0.08 m/s over 1 mm."""
    monkeypatch.setattr(hapticrender, "Player", partial(hapticrender.Player, paced=False))
    assert run_python("README.md")["recording"].summary()["passed"]  # what a new user sees first
    assert re.search(r"80.0 Hz  target     1e-05 m .*\n1.0 s, no flags, 0 lost\n$", capsys.readouterr().out)


def test_python_on_the_page_about_the_finger_runs(run_python):
    """The columns that it writes as CSV give the touch that the recording gives."""
    names = run_python("docs/finger.md")
    analyse = names["hr"].analyse_finger
    assert analyse(names["theirs"]).of_kind(2) == names["found"].of_kind(2)
    assert len(names["touch"].time) == 50


def test_python_on_the_page_about_devices_runs(run_python):
    """The last position is estimated no farther off than the finger has moved."""
    assert abs(run_python("docs/devices.md")["found"].position - 0.0108) < 0.0108 - 0.0100


def test_commands_in_the_readme_are_in_the_makefile():
    verbs = set(re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"^make ([\w-]+)", "".join(blocks("README.md", "sh")), re.MULTILINE))
    assert {"demo", "test"} <= named <= verbs


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMED = re.compile(r"`([\w/]+\.(?:py|c|h|txt))`(?::((?: `[\w.]+`,?)+))?")


@pytest.mark.parametrize(
    ("page", "least", "before"),
    [("theory", 30, r"(?:def|class) "), ("contributing", 20, r"(?m)^[\w, *]*(?:#define )?\b")],
)
def test_names_on_a_page_exist(page, least, before):
    named = NAMED.findall((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"))
    assert len(named) > least
    missing = []
    for file, names in named:
        path = next((each for each in (ROOT / "hapticrender" / file, ROOT / file) if each.exists()), None)
        source = path.read_text(encoding="utf-8") if path else ""
        found = [re.search(rf"{before}{name.split('.')[-1]}\b", source) for name in re.findall(r"[\w.]+", names)]
        if path is None or not all(found):
            missing.append(f"{file}: {names}")
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", text):
        if "://" in target:
            continue
        path = page.parent / target if target else page
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", each).lower().replace(" ", "-") for each in headings}, anchor


PACKAGES = ("numba", "llvmlite")
TYPES = "int32 int64 uint32 uint64 float32 float64 complex128 boolean Float Integer Type CPointer".split()
EXTENSION = "intrinsic lower_builtin models models.PrimitiveModel register_model type_callable".split()
IR = "Constant DoubleType Function FunctionType IntType LiteralStructType PointerType Undefined VectorType".split()
ALLOWED = {  # numba's user manual, extension manual, llvmlite's manual of its IR layer
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
OPTIONS = {"cache", "error_model", "fastmath", "forceinline", "nogil", "_nrt"}  # of njit and cfunc


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


def leftmost(node):
    """Name that an expression begins with, None where it is no name."""
    while node is not None and not isinstance(node, ast.Name):
        node = getattr(node, "value", getattr(node, "func", None))
    return node and node.id


def outside(tree, names):
    """All that a module takes from numba and llvmlite and that is not on the list."""
    found = set(names.values()) - {"numba", "llvmlite", "numba.extending"} - ALLOWED
    for node in ast.walk(tree):
        taken = isinstance(node, ast.Attribute) and leftmost(node) in names
        first, _, rest = ast.unparse(node).partition(".") if taken else ("", "", "")
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
    trees = {path.relative_to(ROOT).as_posix(): tree_of(path) for path in shipped_files()}
    users = {name: outside(tree, names) for name, tree in trees.items() if (names := bound_names(tree))}
    assert {"hapticrender/jit.py", "hapticrender/realtime_kernel.py", "hapticrender/control/kernel.py"} <= set(users)
    assert not {name: found for name, found in users.items() if found}
    assert set(jit.OPTIONS) <= OPTIONS


def test_cached_code_is_named_by_the_state_of_the_sources():
    """numba's cache sees an edit of a function's own file only; parts of a step lie in others."""
    assert close_loop.py_func.__qualname__ == f"close_loop_{digest()}"
    assert error_step.address > 0
    assert error_step.function.__qualname__ == f"error_step_{digest()}"


def test_every_benchmark_finds_what_it_imports():
    """But for packages of the extra `bench`, which it may lack here."""
    for module in pkgutil.walk_packages(benchmarks.__path__, "benchmarks."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if str(error.name).partition(".")[0] in ("benchmarks", "hapticrender", "tests"):
                raise


def test_every_test_that_the_page_on_safety_names_is_there():
    """A name such as `..._the_peak_is_held_...` belongs to the file that is named last before it."""
    names = None
    for word in re.findall(r"`([^`\n]+)`", (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")):
        if found := re.fullmatch(r"(?:tests/)?(test_\w+)(?:\.py)?", word):
            file = ROOT / "tests" / f"{found[1]}.py"
            names = re.findall(r"^def (test_\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
        elif word.startswith("..._"):
            pattern = re.escape(word).replace(re.escape("..."), ".*")
            assert [name for name in names if re.fullmatch(pattern, name)], f"{file.name}: {word}"
