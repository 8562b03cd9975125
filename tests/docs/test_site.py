"""The documentation builds without warnings, and contains the parts that the program fills in."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from app.__main__ import cli

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs` builds it; a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    env = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    call = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(call, cwd=ROOT, env=env, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_parameters_help_routes_and_decisions_are_filled_in(site: Path) -> None:
    assert "ground.alpha" in (site / "reference/parameters.html").read_text()
    assert "--checkpoint-memory" in (site / "commands/serve.html").read_text()
    assert "PATCH /api/params" in (site / "reference/rest.html").read_text()
    assert "001-the-engine" in (site / "decisions/index.html").read_text()
    assert not [page for page in site.rglob("*.html") if "{{ " in page.read_text()]


def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text()
        for mark in ('src="http', '<link rel="stylesheet" href="http', "fonts.googleapis"):
            assert mark not in text, f"{page.name} loads something from another host"


def test_the_readme_is_short_and_its_links_lead_somewhere() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    links = [part.partition(")")[0] for part in text.split("](")[1:]]
    missing = [link for link in links if not link.startswith("http") and not (ROOT / link).exists()]
    assert not missing


def test_every_command_in_the_documentation_is_understood() -> None:
    group = typer.main.get_command(cli)
    assert isinstance(group, TyperGroup)
    lines = []
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        for block in re.findall(r"```sh\n(.*?)```", path.read_text(), re.DOTALL):
            lines += [line for line in block.replace("\\\n", " ").splitlines() if line.startswith("hemislam ")]
    for line in lines:
        _, name, *arguments = shlex.split(line, comments=True)
        group.commands[name].make_context(name, arguments)  # raises for what the command does not know
    assert len(lines) > 40


def test_every_path_that_the_architecture_names_exists() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    named = re.findall(r"`((?:app|tests|examples|docs)/[\w/.]+)`", text)
    missing = [path for path in named if not (ROOT / path).exists() and "ROOM" not in path]
    assert len(named) > 20 and not missing
