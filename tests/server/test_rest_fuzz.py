"""Valid and invalid requests from the API's own description: each gets an answer, and none is a server error."""

from collections.abc import Iterator

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from server_site import TIMEOUT_S, Site, engine_recording, serving
from test_rewind import SAMPLE

from app.server.access import Access
from app.server.folders import Folders
from app.server.setup import Setup
from app.server.viser_adapter import Viser
from app.server.web import make_app
from app.server.worker import EngineProcess
from app.slam.params import Params
from benchmarks.fuzz.requests import Document, Sent

JSON = {"Content-Type": "application/json"}
EXPORT = "/api/export/{name}"
UPLOAD = "/api/recordings/{name}"
MAY_BE_REFUSED = ("/api/recordings", "/api/truth", "/api/params", "/api/export/", "/api/notes/")
"""Whether a request is accepted there depends on more than its form: on files, other values, and what there is."""


def described() -> Document:
    document = make_app(None, Folders([]), None, Access(0)).openapi()  # type: ignore[arg-type]
    return Document(document, {("PATCH", "/api/params"): {"$ref": "#/components/schemas/Params"}})


@pytest.fixture(scope="module")
def real() -> Iterator[Site]:
    """The engine itself, with loops, playing."""
    engine = EngineProcess(Setup(SAMPLE, params=Params(), duration_s=4.0, play=True, speed=10.0))
    engine_recording(engine)
    with serving(engine, Viser(None, ""), SAMPLE.parent, None) as site:  # type: ignore[arg-type]
        yield site
    engine.close()


def check(client: httpx.Client, site: Site, sent: Sent) -> None:
    """Send it, and check that the engine and the server go on."""
    pid, session = site.engine.pid, site.engine.snapshot.session
    answer = client.request(sent.method, site.url(sent.path), content=sent.body, headers=JSON if sent.body else {})
    assert answer.status_code < 500, (sent, answer.text)
    if sent.valid and not sent.path.startswith(MAY_BE_REFUSED):
        assert answer.is_success, (sent, answer.text)
    if answer.headers["content-type"] == "application/json":
        answer.json()
    assert site.engine.pid == pid and site.engine.snapshot.session >= session
    assert client.get(site.url("/healthz")).status_code == 200


@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(sents=st.lists(described().requests(frozenset({EXPORT, UPLOAD})), min_size=1, max_size=4))
def test_no_request_breaks_anything(real: Site, sents: list[Sent]) -> None:
    limits = httpx.Limits(keepalive_expiry=1.0)  # well before the server closes what is idle, after five
    with httpx.Client(timeout=TIMEOUT_S, limits=limits) as client:
        for sent in sents:
            check(client, real, sent)
