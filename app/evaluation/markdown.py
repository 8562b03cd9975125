"""The report as Markdown: the same tables and sentences, without pictures."""

from collections.abc import Sequence

from app.evaluation.measured import Evaluated
from app.evaluation.tables import Table


def markdown(recordings: Sequence[Evaluated], tables: Sequence[Table], findings: Sequence[str], made_by: str) -> str:
    lines = ["# Evaluation", "", made_by, ""]
    lines += [f"- {finding}" for finding in findings]
    for table in tables:
        lines += ["", f"## {table.title}", "", table.note, ""] if table.note else ["", f"## {table.title}", ""]
        lines.append("| recording | | " + " | ".join(table.columns) + " |")
        lines.append("|" + " --- |" * 2 + " ---: |" * len(table.columns))
        for row in table.rows:
            cells = [f"**{cell}**" if index in row.best else cell for index, cell in enumerate(row.cells)]
            lines.append(f"| {row.group} | {row.label} | " + " | ".join(cells) + " |")
    lines += ["", "## Inputs", ""]
    for recording in recordings:
        lines.append(f"- {recording.name}: `{recording.recording.name}`, SHA-256 `{recording.sha256}`")
        lines.append(f"  - truth: {recording.truth or 'none'}")
        lines += [f"  - {note}" for note in recording.notes]
    lines += ["", "## Variants", ""]
    meanings = {c.name: c.meaning for recording in recordings for c in recording.columns}
    lines += [f"- {name}: {meaning or 'as given'}" for name, meaning in meanings.items()]
    return "\n".join(lines) + "\n"
