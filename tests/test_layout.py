"""The tests of every module can be found: by the name of a file, or by its docstring.

The tests of app/ROOM/module.py are in a file test_module.py below tests/, or in a file whose docstring says
`Tests app/ROOM/module.py`.
"""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_every_module_has_tests_that_one_finds() -> None:
    files = list((ROOT / "tests").rglob("test_*.py"))
    names = {path.stem.removeprefix("test_") for path in files}
    said = " ".join(ast.get_docstring(ast.parse(path.read_text())) or "" for path in files)
    modules = [path for path in (ROOT / "app").rglob("*.py") if path.name != "__init__.py"]
    missing = [
        module.relative_to(ROOT).as_posix()
        for module in sorted(modules)
        if module.stem not in names and module.relative_to(ROOT).as_posix() not in said
    ]
    assert len(modules) > 100 and not missing, "\n".join(missing)


def test_modules_that_tests_name_exist() -> None:
    for path in (ROOT / "tests").rglob("test_*.py"):
        docstring = ast.get_docstring(ast.parse(path.read_text())) or ""
        named = [word.strip(".,;:`") for word in docstring.split() if word.startswith(("app/", "`app/"))]
        gone = [name for name in named if name.endswith(".py") and "ROOM" not in name and not (ROOT / name).exists()]
        assert not gone, f"{path.name} names {gone}"
