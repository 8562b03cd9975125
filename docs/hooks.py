"""Fills in what the program itself knows when the site is built: help texts, parameters, REST routes.

A line `{{ help run }}` becomes the output of `hemislam run --help`, `{{ parameters }}` the table of all parameters,
`{{ routes }}` the table of REST routes, and `{{ decisions }}` the list of decisions.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs with the text of each page."""
    return re.sub(r"^\{\{ (\w+)(?: (\w+))? \}\}$", _filled, markdown, flags=re.MULTILINE)


def on_config(config: Any) -> Any:
    """Called by mkdocs with its configuration: lists every decision in the navigation."""
    for section in config.nav:
        if "Decisions" in section:
            section["Decisions"] += [{_title(path): f"decisions/{path.name}"} for path in _decisions()]
    return config


def _filled(found: re.Match[str]) -> str:
    what, argument = found.groups()
    match what:
        case "help":
            return f"```text\n{_help(argument)}\n```"
        case "parameters":
            from app.slam.params import params_markdown

            return params_markdown()
        case "routes":
            return _routes()
        case "decisions":
            return "\n".join(f"- [{_title(path)}]({path.name})" for path in _decisions())
    raise ValueError(f"docs/hooks.py cannot fill in {found.group()}")


def _help(command: str) -> str:
    env = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    call = [sys.executable, "-m", "app", command, "--help"]
    text = subprocess.run(call, capture_output=True, text=True, check=True, env=env).stdout
    lines = (re.sub("[╭╮╰╯│─]", "", line).rstrip() for line in text.splitlines())
    return "\n".join(line for line in lines if line.strip())


def _routes() -> str:
    from fastapi import FastAPI

    from app.server.api import make_router

    api: Any = FastAPI()
    api.include_router(make_router(None, None))  # type: ignore[arg-type]  # the routes are listed, never called
    rows = ["| route | what it does |", "| --- | --- |"]
    for path, verbs in api.openapi()["paths"].items():
        for verb, route in verbs.items():
            rows.append(f"| `{verb.upper()} {path}` | {' '.join(route.get('description', '').split())} |")
    return "\n".join(rows)


def _decisions() -> list[Path]:
    return sorted((DOCS / "decisions").glob("[0-9]*.md"))


def _title(path: Path) -> str:
    return f"{path.name[:3]} {path.read_text(encoding='utf-8').splitlines()[0].removeprefix('# ')}"
