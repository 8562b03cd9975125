"""No import cycles, over any number of steps; no two types in app share a name."""

import ast
from collections import defaultdict
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[1]


def test_there_are_no_import_circles() -> None:
    graph = grimp.build_graph("app", cache_dir=None)
    modules = sorted(graph.modules)
    circles = [
        chain
        for module in modules
        for imported in graph.find_modules_directly_imported_by(module)
        if (chain := graph.find_shortest_chain(imported, module))
    ]
    assert len(modules) > 100 and not circles, circles[:3]


def test_no_two_types_share_a_name() -> None:
    """Classes, and other types that are given a name, such as Vector = tuple[float, float, float]."""
    places = defaultdict(list)
    for path in (ROOT / "app").rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            name = node.name if isinstance(node, ast.ClassDef) else ""
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                name = node.targets[0].id if not node.targets[0].id.isupper() else ""
            if name[:1].isupper():
                places[name].append(path.relative_to(ROOT).as_posix())
    shared = {name: paths for name, paths in places.items() if len(paths) > 1}
    assert not shared, shared
