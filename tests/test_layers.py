"""The architecture as a law: imports point one way, and nothing unsafe is loaded or run."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "solar_cli"
LAYERS = (
    ("errors", "stopwatch", "streams", "pulse", "wording"),
    ("settings",),
    ("inference",),
    ("envs",),
    ("episodes",),
    ("experience",),
    ("models",),
    ("control",),
    ("methods",),
    ("store",),
    ("experiment",),
    ("reporting",),
    ("cli",),
)
"""Each imports only from those before it. The front door ``solar_cli/__init__.py`` is above all."""
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
UNSAFE_MODULES = {"pickle", "_pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve"}
UNSAFE_CALLS = {"eval", "exec", "compile", "__import__"}

FILES = sorted(PACKAGE.rglob("*.py"))


def part(path: Path) -> str:
    """The layer of a file: its folder, or its own name."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(tree: ast.AST, package: str) -> Iterator[tuple[int, str]]:
    """(line, absolute module) of every import, wherever it stands and under any condition."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parent = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parent, base] if base else parent)
            yield node.lineno, base
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def upward(source: str, layer: str, package: str) -> list[str]:
    """The imports of ``source``, a file of ``layer``, that point up the list."""
    faults = []
    for line, module in imports(ast.parse(source), package):
        names = module.split(".")
        if names[0] != "solar_cli" or len(names) < 2:
            continue
        if LEVEL.get(names[1], -1) > LEVEL[layer]:
            faults.append(f"line {line}: {layer} imports {module}")
    return faults


def unsafe(source: str) -> list[str]:
    """Whatever could run code that stands in a file of data."""
    tree = ast.parse(source)
    faults = [
        f"line {line}: imports {module}"
        for line, module in imports(tree, "")
        if module.split(".")[0] in UNSAFE_MODULES
    ]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        keywords = {
            word.arg: word.value.value
            for word in node.keywords
            if isinstance(word.value, ast.Constant)
        }
        called = ast.unparse(node.func)
        if called in UNSAFE_CALLS:
            faults.append(f"line {node.lineno}: {called}()")
        if called == "torch.load" and keywords.get("weights_only") is not True:
            faults.append(f"line {node.lineno}: torch.load without weights_only=True")
        for word in ("allow_pickle", "shell"):
            if keywords.get(word) is True:
                faults.append(f"line {node.lineno}: {called}({word}=True)")
    return faults


def test_every_part_of_the_package_has_its_layer() -> None:
    assert {part(path) for path in FILES} - {"__init__", "_tasks"} <= set(LEVEL)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_one_way_and_nothing_unsafe_is_used(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    assert unsafe(source) == []
    if part(path) != "__init__":
        package = ".".join(["solar_cli", *path.relative_to(PACKAGE).parts[:-1]])
        assert upward(source, part(path), package) == []


@pytest.mark.parametrize(
    "source",
    [
        "from solar_cli.store.store import Store",
        "import solar_cli.cli",
        "from solar_cli import reporting",
        "def f():\n    from solar_cli.experiment import matrix",
        "from ..store import records",
    ],
)
def test_an_import_that_points_up_is_seen(source: str) -> None:
    assert upward(source, "models", "solar_cli.models")


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "eval('1')",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
        "subprocess.run('ls', shell=True)",
    ],
)
def test_an_unsafe_call_is_seen(source: str) -> None:
    assert unsafe(source)


@pytest.mark.parametrize(
    "source",
    ["model.eval()", "torch.load(path, weights_only=True)", "np.load(path, allow_pickle=False)"],
)
def test_a_safe_call_is_left_alone(source: str) -> None:
    assert unsafe(source) == []
