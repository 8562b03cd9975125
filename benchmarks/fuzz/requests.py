"""Valid and invalid requests, generated from the API's OpenAPI document."""

import json
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

Json = Any

WORDS = (
    "",
    ".",
    "..",
    "/",
    "/etc/passwd",
    "cloister.mcap",
    "cloister_truth.tum",
    "cloister.params.yaml",
    "\0",
    "\ud800",
)
ODD: SearchStrategy[Json] = st.sampled_from(
    [None, True, -1, 0, 2**31, 2**63, 2**64, -(10**400), 1e308, 1e-320, -0.0, float("nan"), float("inf"), *WORDS,
     "9" * 5000, "é" * 1500, [], {}, [[]], {"": None}, [0] * 500]
)  # fmt: skip
ANYTHING = ODD | st.recursive(
    ODD | st.text(max_size=5) | st.integers() | st.floats(),
    lambda part: st.lists(part, max_size=3) | st.dictionaries(st.text(max_size=4), part, max_size=3),
    max_leaves=8,
)


@dataclass(frozen=True)
class Sent:
    """A request. valid: whether it conforms to the document."""

    method: str
    path: str
    body: bytes | None = None
    valid: bool = True


class Document:
    """Generates requests.

    Args:
        hints: schemas of bodies that the document does not specify, by (method, path).
    """

    def __init__(self, document: Json, hints: dict[tuple[str, str], Json]) -> None:
        self._document, self._hints = document, hints

    def requests(self, skip: frozenset[str] = frozenset()) -> SearchStrategy[Sent]:
        """Any request in the document, except on skipped paths."""
        found = []
        for path, methods in self._document["paths"].items():
            if path not in skip:
                found += [self._requests(method.upper(), path, operation) for method, operation in methods.items()]
        return st.one_of(found)

    def _requests(self, method: str, path: str, operation: Json) -> SearchStrategy[Sent]:
        paths = st.just(path)
        for parameter in operation.get("parameters", ()):
            hole, values = f"{{{parameter['name']}}}", self.values(parameter["schema"])
            paths = st.tuples(paths, values).map(lambda pair, hole=hole: pair[0].replace(hole, str(pair[1])))  # type: ignore[misc]
        if "requestBody" not in operation:
            return paths.map(lambda path: Sent(method, path))
        said = operation["requestBody"]["content"]["application/json"]["schema"]
        values = self.values(self._hints.get((method, path), said))
        valid = st.tuples(paths, values).map(lambda pair: Sent(method, pair[0], encoded(pair[1])))
        broken = st.tuples(paths, values.flatmap(mutated)).map(lambda pair: Sent(method, *pair, valid=False))
        return valid | broken

    def values(self, schema: Json) -> SearchStrategy[Json]:
        """Values that conform to a schema."""
        if "$ref" in schema:
            return self.values(self._document["components"]["schemas"][schema["$ref"].rpartition("/")[2]])
        for name in ("anyOf", "oneOf"):
            if name in schema:
                return st.one_of([self.values(one) for one in schema[name]])
        if "const" in schema:
            return st.just(schema["const"])
        if "enum" in schema:
            return st.sampled_from(schema["enum"])
        made: SearchStrategy[Json] = getattr(self, f"_{schema['type']}")(schema)
        return made

    def _object(self, schema: Json) -> SearchStrategy[Json]:
        properties = {name: self.values(one) for name, one in schema.get("properties", {}).items()}
        needed = {name: one for name, one in properties.items() if name in schema.get("required", ())}
        return st.fixed_dictionaries(
            needed, optional={name: one for name, one in properties.items() if name not in needed}
        )

    def _array(self, schema: Json) -> SearchStrategy[Json]:
        if "prefixItems" in schema:
            return st.tuples(*map(self.values, schema["prefixItems"])).map(list)
        return st.lists(self.values(schema["items"]), max_size=schema.get("maxItems", 4))

    def _string(self, schema: Json) -> SearchStrategy[Json]:
        least, most = schema.get("minLength", 0), schema.get("maxLength", 2000)
        words = st.sampled_from([word for word in WORDS if least <= len(word) <= most and word.isascii()])
        return words | st.text(st.characters(codec="utf-8"), min_size=least, max_size=min(most, least + 20))

    def _integer(self, schema: Json) -> SearchStrategy[Json]:
        low, high = schema.get("minimum"), schema.get("maximum")
        return st.integers(low if low is None else int(low), high if high is None else int(high))

    def _number(self, schema: Json) -> SearchStrategy[Json]:
        low, high = schema.get("minimum", schema.get("exclusiveMinimum")), schema.get("maximum")
        return st.floats(
            low, high, allow_nan=False, allow_infinity=False, exclude_min="exclusiveMinimum" in schema
        )  # fmt: skip

    def _boolean(self, _: Json) -> SearchStrategy[Json]:
        return st.booleans()

    def _null(self, _: Json) -> SearchStrategy[Json]:
        return st.none()


def encoded(value: Json) -> bytes:
    """JSON, but with NaN and lone surrogates as written by Python."""
    return json.dumps(value).encode("ascii")


@st.composite
def mutated(draw: st.DrawFn, value: Json) -> bytes:
    """A body that is invalid, or valid by chance."""
    kind = draw(st.sampled_from(["part", "part", "part", "more", "less", "other", "bytes"]))
    if kind == "other" or not isinstance(value, dict):
        return encoded(draw(ANYTHING))
    if kind == "bytes":
        whole = encoded(value)
        at = draw(st.integers(0, len(whole)))
        return whole[:at] + draw(st.binary(max_size=4)) + whole[at + draw(st.integers(0, 3)) :]
    changed = dict(value)
    if kind == "more":
        changed[draw(st.text(max_size=6))] = draw(ANYTHING)
    elif changed:
        name = draw(st.sampled_from(sorted(changed)))
        if kind == "less":
            del changed[name]
        elif isinstance(changed[name], dict) and changed[name]:
            inner = draw(st.sampled_from(sorted(changed[name])))
            changed[name] = {**changed[name], inner: draw(ANYTHING)}
        else:
            changed[name] = draw(ANYTHING)
    return encoded(changed)
