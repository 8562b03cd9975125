"""The parameter tree: every declaration is complete, every value survives YAML, every mistake is named.

Tests app/slam/errors.py, app/slam/user_text.py.
"""

from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from app.slam.errors import HemislamError
from app.slam.params import WHEN, Leaf, Params, leaves, params_markdown

LEAVES = leaves()
NUMBERS = [
    leaf for leaf in LEAVES if isinstance(leaf.default, int | float | tuple) and not isinstance(leaf.default, bool)
]


def component(leaf: Leaf) -> Any:
    return leaf.default[0] if isinstance(leaf.default, tuple) else leaf.default


def as_value(leaf: Leaf, number: Any) -> Any:
    """The number as a value of this parameter: a vector gets it as its last component."""
    return [0.0, 0.0, number] if isinstance(leaf.default, tuple) else number


def by_path(leaf: Leaf) -> str:
    return leaf.path


def any_value(leaf: Leaf) -> st.SearchStrategy[Any]:
    """What a user may set a parameter to."""
    if leaf.choices:
        return st.sampled_from(leaf.choices)
    if isinstance(leaf.default, bool):
        return st.booleans()
    if leaf.path.endswith("_axes"):
        return st.sampled_from(["xyz", "-yxz", "z-x-y"])
    if leaf.path.endswith("_corrections"):
        return st.sampled_from(["", "0.12 -0.3 0", "-0.004 1"])
    if isinstance(leaf.default, str):
        return st.sampled_from(["", "auto", "/a topic: #1", "yes", "12", "1e3", "~", "'"])
    assert leaf.minimum is not None and leaf.maximum is not None
    if isinstance(leaf.default, tuple):
        return st.tuples(*[st.floats(leaf.minimum, leaf.maximum)] * 3)
    if isinstance(leaf.default, int):
        return st.integers(int(leaf.minimum), int(leaf.maximum))
    return st.floats(leaf.minimum, leaf.maximum)


any_values = st.fixed_dictionaries({}, optional={leaf.path: any_value(leaf) for leaf in LEAVES})


@pytest.mark.parametrize("leaf", LEAVES, ids=by_path)
def test_every_parameter_is_declared_completely(leaf: Leaf) -> None:
    assert leaf.meaning.endswith(".")
    assert Params().value(leaf.path) == leaf.default


@pytest.mark.parametrize("leaf", NUMBERS, ids=by_path)
def test_every_number_has_a_range_and_a_step_for_its_slider(leaf: Leaf) -> None:
    assert leaf.minimum is not None and leaf.maximum is not None and leaf.step is not None
    assert leaf.minimum <= component(leaf) <= leaf.maximum
    assert 0 < leaf.step <= leaf.maximum - leaf.minimum


@settings(max_examples=40, deadline=None)
@given(any_values)
def test_what_is_printed_is_read_back_to_the_last_digit(values: dict[str, Any]) -> None:
    params = Params().with_values(values)
    assert Params().merged_yaml(params.to_yaml()) == params
    assert Params().merged(yaml.safe_load(params.to_yaml())) == params
    assert Params().changed(params).keys() <= values.keys()
    assert Params().with_values(Params().changed(params)) == params


@settings(max_examples=25, deadline=None)
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
    for beyond in (leaf.minimum - 1, leaf.maximum + 1, 1e308, float("nan"), float("inf"), "much"):
        value = as_value(leaf, beyond)
        with pytest.raises(HemislamError) as error:
            Params().with_values({leaf.path: value})
        says = str(error.value)
        assert says.startswith(f"`{leaf.path}` cannot be {value!r}: it must be ")
        assert f"from {leaf.minimum:g} to {leaf.maximum:g}" in says
        assert leaf.unit in says


@pytest.mark.parametrize("leaf", NUMBERS, ids=by_path)
def test_both_ends_of_a_range_belong_to_it(leaf: Leaf) -> None:
    for end in (leaf.minimum, leaf.maximum):
        value = as_value(leaf, end)
        found = Params().with_values({leaf.path: value}).value(leaf.path)
        assert (list(found) if isinstance(found, tuple) else found) == value


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
        ({"ground.alpha": True}, "`ground.alpha` cannot be True: it must be a number"),  # YAML reads `yes` as true
        ({"ground.scan_lines": False}, "cannot be False: it must be a whole number"),
        ({"sensor.translation": [0.1, True, 0.2]}, "it must be 3 numbers"),
        ({"sensor.translation": [1, 2]}, "cannot be [1, 2]: it must be 3 numbers from -100 to 100 m"),
        ({"recording.imu_topic": 5}, "a text"),
        ({"recording.imu_time_offset": float("nan")}, "a number from -4e+09 to 4e+09 s"),
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
        ("ground: {alpha: 30}\nfilter: {}\nground: {sigma: 0.1}", "in line 3, where `ground` stands a second time"),
        ("ground: {alpha: 30, alpha: 40}", "in line 1, where `alpha` stands a second time"),
        ("? [1, 2]\n: 3", "mine.yaml is not valid YAML in line 1"),
        ("[" * 5000, "mine.yaml is nested too deeply"),
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


def test_parameters_cannot_be_changed_in_place() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Params().ground.alpha = 30  # type: ignore[misc]


def test_the_comments_tell_meaning_unit_range_and_effect() -> None:
    text = Params().to_yaml()
    for leaf in LEAVES:
        assert f"# {leaf.help}" in text
    assert "[unit deg; 1 to 90; applies at once]" in text


def test_the_documentation_shows_every_parameter_in_the_table_of_its_section() -> None:
    headings = params_markdown().split("## ")[1:]
    assert [text.partition("\n")[0] for text in headings] == list(Params.model_fields)
    for leaf in LEAVES:
        (row,) = [line for text in headings for line in text.splitlines() if line.startswith(f"| `{leaf.path}` |")]
        cells = [cell.strip() for cell in row.strip("|").split(" | ")]
        assert cells[1] == leaf.symbol and cells[3:] == [leaf.range, leaf.unit, WHEN[leaf.effect], leaf.meaning]
        assert yaml.safe_load(cells[2].strip("`")) == (
            list(leaf.default) if type(leaf.default) is tuple else leaf.default
        )
