"""Requests to a running workbench: each gets an answer, none is a server error, and the workbench keeps running."""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
from hypothesis import HealthCheck, Phase, given, seed, settings

from benchmarks.fuzz.requests import Document, Sent

ROOT = Path(__file__).resolve().parents[2]
REQUESTS_AT_ONCE = 20
JSON = {"Content-Type": "application/json"}
SLOW = frozenset({"/api/export/{name}"})
"""Paths requested only now and then, elsewhere, because they write the whole map."""


class Rest:
    """A workbench that starts with the first case. Close it at the end.

    Args:
        recording: to open.
    """

    def __init__(self, recording: Path) -> None:
        self._recording = recording
        self._server: subprocess.Popen[bytes] | None = None
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        self._told = 0
        self._client = httpx.Client(timeout=60.0, limits=httpx.Limits(keepalive_expiry=1.0))

    def close(self) -> None:
        if self._server is not None:
            self._server.terminate()
            self._server.wait()
        self._client.close()
        self._said.close()

    def broken(self, number: int) -> str:
        """The request among twenty that breaks an invariant, and how; "" if none."""
        if self._server is None:
            self._start()
        failures: list[str] = []

        @seed(number)
        @settings(
            max_examples=REQUESTS_AT_ONCE, database=None, deadline=None, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(self._document.requests(SLOW | {"/api/recordings/{name}"}))
        def send(sent: Sent) -> None:
            answer = self._client.request(
                sent.method, sent.path, content=sent.body, headers=JSON if sent.body is not None else {}
            )
            if answer.status_code >= 500:
                failures.append(f"{sent}: {answer.status_code} {answer.text[:300]}")

        send()
        if self._client.get("/healthz").status_code != 200:
            failures.append("the workbench is not well any more")
        said = self._news()
        if "Traceback" in said:
            failures.append(said[said.index("Traceback") :][:3000])
        return "\n".join(failures)

    def _start(self) -> None:
        arguments = ["serve", str(self._recording), "--port", "0", "--no-browser", "--paused"]
        self._server = subprocess.Popen(
            [sys.executable, "-m", "app", *arguments], cwd=ROOT, stdout=self._said, stderr=subprocess.STDOUT
        )
        until, said = time.monotonic() + 60.0, ""
        while not (found := re.search(r"http://[^\s/]+", said)):
            assert time.monotonic() < until and self._server.poll() is None, said
            time.sleep(0.2)
            said += self._news()
        self._client.base_url = httpx.URL(found.group())
        hints = {("PATCH", "/api/params"): {"$ref": "#/components/schemas/Params"}}
        self._document = Document(self._client.get("/api/openapi.json").json(), hints)

    def _news(self) -> str:
        """Output of the workbench since the last call."""
        self._said.seek(self._told)
        news = self._said.read()
        self._told += len(news)
        return news.decode(errors="replace")
