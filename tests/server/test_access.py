"""Access control over real sockets: the view-only token, limits of sizes, and log entries."""

import json
import logging
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from server_site import OWNER, VIEWER, Site
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin

from app.logs import JsonLines
from app.server.access import MOST_BYTES, Access
from app.server.address import links


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/api/transport", {"action": "play"}),
        ("PATCH", "/api/params", {"ground": {"alpha": 31}}),
        ("POST", "/api/recordings", {"path": "walk-60.mcap"}),
        ("PUT", "/", None),
        ("DELETE", "/api/state", None),
    ],
)
def test_the_view_only_token_changes_nothing_by_rest(public_site: Site, method: str, path: str, body: Any) -> None:
    before = public_site.engine.snapshot.params
    answer = httpx.request(method, public_site.url(path), json=body, headers=VIEWER)
    assert answer.status_code == 403 and "view only" in answer.text
    assert public_site.engine.snapshot.params == before


def test_the_view_only_token_sees_the_state_and_the_page(public_site: Site) -> None:
    for path in ("/api/state", "/api/params", "/api/openapi.json"):
        assert httpx.get(public_site.url(path), headers=VIEWER).status_code == 200
    seen, owned = (httpx.get(public_site.url(), headers=headers).text for headers in (VIEWER, OWNER))
    assert "View only" in seen and "View only" not in owned


def test_the_view_only_link_makes_nobody_an_owner(public_site: Site) -> None:
    with httpx.Client() as browser:
        answer = browser.get(public_site.url("/?token=for-viewers"))
        assert answer.status_code == 303 and "for-viewers" in answer.headers["set-cookie"]
        for query in ("?token=wrong", "?token=", "?token=for-owner", "?token=for-viewers&token=wrong"):
            browser.get(public_site.url(f"/{query}"))
            assert "for-owners" not in str(browser.cookies)
        assert browser.post(public_site.url("/api/transport"), json={"action": "play"}).status_code == 403
        assert browser.get(public_site.url("/?token=for-owners")).status_code == 303
        assert browser.post(public_site.url("/api/transport"), json={"action": "pause"}).status_code == 202


def test_the_view_only_token_does_not_let_another_site_in(public_site: Site) -> None:
    evil = "http://evil.example"
    assert httpx.get(public_site.url("/api/state"), headers=VIEWER | {"Origin": evil}).status_code == 403
    with pytest.raises(InvalidStatus):
        public_site.socket(additional_headers=VIEWER, origin=Origin(evil))
    with pytest.raises(InvalidStatus):
        public_site.socket(additional_headers={"Authorization": "Bearer wrong"})


def test_the_two_tokens_differ_and_exist_only_where_others_could_reach_us() -> None:
    public = Access.on("0.0.0.0", 1)
    assert public.token and public.viewer_token and public.token != public.viewer_token
    assert Access.on("127.0.0.1", 1).viewer_token is None
    assert all(public.token not in link for link in links("0.0.0.0", public, public.viewer_token))


def test_a_body_that_is_too_large_is_refused_with_or_without_its_length(public_site: Site) -> None:
    large = b" " * (MOST_BYTES + 1)
    announced = httpx.post(public_site.url("/api/transport"), content=large, headers=OWNER)
    assert announced.status_code == 413

    def parts() -> Iterator[bytes]:
        for _ in range(4):
            yield large[: MOST_BYTES // 2]

    chunked = httpx.post(
        public_site.url("/api/transport"), content=parts(), headers=OWNER | {"Content-Type": "application/json"}
    )
    assert chunked.status_code == 413


def test_a_refusal_is_logged_as_one_line_of_json_without_the_token(public_site: Site, caplog: Any) -> None:
    httpx.get(public_site.url("/api/state?token=my-guess"))
    (record,) = [record for record in caplog.records if record.name == "app.server.access"]
    (line,) = JsonLines("server").format(record).splitlines()
    entry = json.loads(line)
    assert entry["level"] == "warning" and entry["status"] == 401 and "127.0.0.1" in entry["message"]
    assert "my-guess" not in line


@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer wrong"}, OWNER | {"Origin": "http://evil.example"}])
def test_a_refusal_binds_the_browser_as_every_answer_does(public_site: Site, headers: dict[str, str]) -> None:
    answer = httpx.get(public_site.url("/api/state"), headers=headers)
    assert answer.status_code in (401, 403)
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "frame-ancestors" in answer.headers["content-security-policy"]


def test_head_answers_as_get_without_the_body(public_site: Site) -> None:
    for path in ("/", "/healthz", "/api/state"):
        head, get = (httpx.request(method, public_site.url(path), headers=OWNER) for method in ("HEAD", "GET"))
        assert head.status_code == get.status_code == 200 and head.content == b""
        assert head.headers["content-type"] == get.headers["content-type"]
    assert httpx.head(public_site.url("/api/state")).status_code == 401


def test_a_path_of_any_length_is_one_short_line_of_the_log(public_site: Site, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("WARNING", logger="app"):
        logging.getLogger("app").propagate = True
        assert httpx.get(public_site.url("/" + "x" * 50_000)).status_code == 401
    (line,) = {record.getMessage() for record in caplog.records if "Refused" in record.getMessage()}
    assert len(line) < 400
