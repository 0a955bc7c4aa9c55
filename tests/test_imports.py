"""Packages import from those above them in the table of CONTRIBUTING.md, and from no others."""

import ast
import re
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "cfb_mjx"
WHEN_RUN = {("commands", "loop"), ("commands", "sweep"), ("commands", "cli")}
"""A command imports these when it runs: they run other commands, a sweep's through the command line."""
FACES = {"__init__", "demo"}
"""Modules beside the packages that bring packages together."""


def table() -> dict[str, int]:
    """Packages, and the modules that use them, with their row."""
    rows = re.findall(r"^\| (`[^|]*`) \|", (ROOT / "CONTRIBUTING.md").read_text(), flags=re.MULTILINE)
    return {re.sub(r"/$|\.py$", "", name): i for i, row in enumerate(rows) for name in re.findall(r"`([^`]*)`", row)}


def imports(path: Path) -> list[tuple[str, bool]]:
    """Modules of the library that a file imports, and whether it does so only when it runs."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "cfb_mjx":
            names = [f"cfb_mjx.{alias.name}" for alias in node.names] if node.module == "cfb_mjx" else [node.module]
            found += [(name, node.col_offset > 0) for name in names]
        if isinstance(node, ast.Import):
            found += [(a.name, node.col_offset > 0) for a in node.names if a.name.split(".")[0] == "cfb_mjx"]
    return found


def package(parts: tuple[str, ...]) -> str:
    """`model` and its effects are one here: the body asks effects for forces, effects are told the state."""
    return parts[1] if len(parts) > 1 else "__init__"


def test_the_table_has_every_package():
    packages = {path.parent.name for path in SOURCE.glob("*/__init__.py")} - {"policies"}
    assert packages <= set(table()), "add a line to the table of CONTRIBUTING.md"


def test_imports_point_upwards():
    order, wrong = table(), []
    for path in sorted(SOURCE.rglob("*.py")):
        here = package(path.relative_to(SOURCE.parent).with_suffix("").parts)
        if here in FACES:
            continue
        for name, when_run in imports(path):
            there = package(tuple(name.split(".")))
            # Modules beside the packages stand above all of them.
            level, above = order.get(here, -1), order.get(there, -1)
            if above > level and not (when_run and (here, there) in WHEN_RUN) and there not in FACES:
                wrong.append(f"{path.relative_to(SOURCE)} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_no_module_imports_itself_by_way_of_others():
    """Not even when it runs. A package's own ``__init__`` is left out: it only lists what the modules have."""
    modules = {".".join(path.relative_to(SOURCE.parent).with_suffix("").parts) for path in SOURCE.rglob("*.py")}
    graph = {}
    for name in modules:
        tree = ast.parse((SOURCE.parent / f"{name.replace('.', '/')}.py").read_text())
        for_types = {
            id(x) for node in ast.walk(tree) if isinstance(node, ast.If) for x in node.body if _types_only(node)
        }
        needed = [
            named if (named := f"{node.module}.{alias.name}") in modules else node.module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module and id(node) not in for_types
            for alias in node.names
        ]
        graph[name] = {other for other in needed if other in modules and other != name}
    assert len(graph) > 100
    assert list(TopologicalSorter(graph).static_order())


def _types_only(node: ast.If) -> bool:
    return isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


MODULES = {
    "mcap-ros2-support": "mcap_ros2",
    "mujoco-mjx": "mujoco",
    "pillow": "PIL",
    "protobuf": "google",
    "pyyaml": "yaml",
}
"""Names of modules, where they are not those of the packages."""


def test_every_declared_package_is_imported():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = [re.match(r"[\w-]+", line)[0] for line in project["dependencies"]]
    text = "\n".join(path.read_text() for path in SOURCE.rglob("*.py"))
    wanted = {name: MODULES.get(name, name.removesuffix("-sdk")) for name in names}
    assert [n for n, m in wanted.items() if not re.search(rf"^\s*(import|from) {m}\b", text, re.MULTILINE)] == []
