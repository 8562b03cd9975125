"""No module imports, over however many steps, a module that imports it; no two classes of app share a name."""

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


def test_no_two_classes_share_a_name() -> None:
    places = defaultdict(list)
    for path in (ROOT / "app").rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path.relative_to(ROOT).as_posix())
    shared = {name: paths for name, paths in places.items() if len(paths) > 1}
    assert not shared, shared
