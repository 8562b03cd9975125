"""The parameter tree: every declaration is complete, every value survives YAML, every mistake is named."""

from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from app.slam.errors import HemislamError
from app.slam.params import Leaf, Params, leaves

LEAVES = leaves()
NUMBERS = [leaf for leaf in LEAVES if leaf.minimum is not None]


def by_path(leaf: Leaf) -> str:
    return leaf.path


def any_value(leaf: Leaf) -> st.SearchStrategy[Any]:
    """What a user may set a parameter to."""
    if leaf.choices:
        return st.sampled_from(leaf.choices)
    if isinstance(leaf.default, bool):
        return st.booleans()
    if isinstance(leaf.default, str):
        return st.sampled_from(["", "auto", "/a topic: #1", "yes", "12", "1e3", "~", "'"])
    if isinstance(leaf.default, tuple):
        return st.tuples(*[st.floats(-1e6, 1e6)] * 3)
    if leaf.minimum is None or leaf.maximum is None:
        return st.floats(-1e12, 1e12)
    if isinstance(leaf.default, int):
        return st.integers(int(leaf.minimum), int(leaf.maximum))
    return st.floats(leaf.minimum, leaf.maximum)


any_values = st.fixed_dictionaries({}, optional={leaf.path: any_value(leaf) for leaf in LEAVES})


@pytest.mark.parametrize("leaf", LEAVES, ids=by_path)
def test_every_parameter_is_declared_completely(leaf: Leaf) -> None:
    assert leaf.meaning.endswith(".")
    assert Params().value(leaf.path) == leaf.default
    assert (leaf.minimum is None) == (leaf.maximum is None)
    if leaf.minimum is not None and leaf.maximum is not None:
        assert leaf.step is not None
        assert leaf.minimum <= leaf.default <= leaf.maximum
        assert 0 < leaf.step <= leaf.maximum - leaf.minimum


@settings(max_examples=100, deadline=None)
@given(any_values)
def test_what_is_printed_is_read_back_to_the_last_digit(values: dict[str, Any]) -> None:
    params = Params().with_values(values)
    assert Params().merged_yaml(params.to_yaml()) == params
    assert Params.parse(yaml.safe_load(params.to_yaml(comments=False))) == params
    assert Params().changed(params).keys() <= values.keys()
    assert Params().with_values(Params().changed(params)) == params


@settings(max_examples=50, deadline=None)
@given(any_values)
def test_an_assignment_on_the_command_line_reads_as_yaml(values: dict[str, Any]) -> None:
    texts = [
        f"{path}={yaml.safe_dump(list(v) if isinstance(v, tuple) else v, default_flow_style=True, width=1000)}"
        for path, v in values.items()
    ]
    assert Params().with_assignments(texts) == Params().with_values(values)


@pytest.mark.parametrize("leaf", NUMBERS, ids=by_path)
def test_a_value_out_of_range_is_refused_with_name_range_and_unit(leaf: Leaf) -> None:
    assert leaf.minimum is not None and leaf.maximum is not None
    for beyond in (leaf.minimum - 1, leaf.maximum + 1, float("nan"), float("inf"), "much"):
        with pytest.raises(HemislamError) as error:
            Params().with_values({leaf.path: beyond})
        says = str(error.value)
        assert says.startswith(f"`{leaf.path}` can not be {beyond!r}: it must be a")
        assert f"from {leaf.minimum:g} to {leaf.maximum:g}" in says
        assert leaf.unit in says


@pytest.mark.parametrize("leaf", NUMBERS, ids=by_path)
def test_both_ends_of_a_range_belong_to_it(leaf: Leaf) -> None:
    for end in (leaf.minimum, leaf.maximum):
        assert Params().with_values({leaf.path: end}).value(leaf.path) == end


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"ground.alfa": 30}, "no parameter `ground.alfa`; did you mean `ground.alpha`?"),
        ({"gruond.alpha": 30}, "no section `gruond`; did you mean `ground`?"),
        ({"alpha": 30}, "no parameter `alpha`; did you mean `ground.alpha`?"),
        ({"ground.qqqqqqqq": 30}, "`hemislam params` lists them all"),
        ({"recording.time_unit": "min"}, "one of auto, s, ms, us, ns"),
        ({"ground.scan_lines": 3.5}, "a whole number from 1 to 128"),
        ({"ground.enabled": "perhaps"}, "true or false"),
        ({"sensor.translation": [1, 2]}, "can not be [1, 2]: it must be 3 numbers"),
        ({"recording.imu_topic": 5}, "a text"),
        ({"recording.imu_time_offset": float("nan")}, "a number (s)"),
    ],
)
def test_a_mistake_is_named_with_what_would_be_right(values: dict[str, Any], says: str) -> None:
    with pytest.raises(HemislamError) as error:
        Params().with_values(values)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("\nground: [", "mine.yaml is not valid YAML in line 2"),
        ("30", "mine.yaml: Parameters must be a mapping of sections, not int"),
        ("ground: 30", "section `ground` must hold `name: value` lines"),
        ("1: {alpha: 3}", "no section `1`"),
        ("ground: {1: 3}", "no parameter `ground.1`"),
    ],
)
def test_a_file_that_holds_no_parameters_is_named(text: str, says: str) -> None:
    with pytest.raises(HemislamError) as error:
        Params().merged_yaml(text, "mine.yaml")
    assert says in str(error.value)


def test_what_a_file_leaves_out_stays_as_it_was() -> None:
    before = Params().with_values({"ground.alpha": 30, "scan.voxel_size": 0.7})
    after = before.merged_yaml("ground: {sigma: 0.05}\nfilter:\n")
    assert before.changed(after) == {"ground.sigma": 0.05}
    assert before.merged_yaml("") == before


def test_parameters_can_not_be_changed_in_place() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Params().ground.alpha = 30  # type: ignore[misc]


def test_the_comments_tell_meaning_unit_range_and_effect() -> None:
    text = Params().to_yaml()
    for leaf in LEAVES:
        assert f"# {leaf.help}" in text
    assert "[unit deg; 1 to 90; acts at once]" in text
