"""Seeds, budgets and the names of variants."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from solar_cli.errors import UsageError
from solar_cli.settings import cells, load_card, parse_budget, parse_seeds
from solar_cli.settings.cell import variant_name


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("1", [0]),
        ("3", [0, 1, 2]),
        ("3,5,8", [3, 5, 8]),
        ("5,", [5]),
        ("0:10", list(range(10))),
        ("5:6", [5]),
        ("100:103", [100, 101, 102]),
    ],
)
def test_seeds_are_a_number_a_list_or_a_range(text: str, seeds: list[int]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    "text",
    [
        *("0", "-1", "", "x", "1.5", "5:5", "6:5", "1:2:3", "-2:2", "99999999999"),
        *("1,1", ",", "1,-1", "1,,2", ",1", "1,,", "1, ,2"),
    ],
)
def test_what_is_no_seed_is_refused_with_the_forms(text: str) -> None:
    with pytest.raises(UsageError, match=r"--seeds.*expected"):
        parse_seeds(text)


@given(st.text(alphabet="0123456789,:- x", max_size=8))
def test_any_text_gives_distinct_seeds_or_a_usage_error(text: str) -> None:
    try:
        seeds = parse_seeds(text)
    except UsageError:
        return
    assert seeds
    assert min(seeds) >= 0
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize(("text", "budget"), [("desk", "desk"), ("full", "full"), ("250", 250)])
def test_a_budget_is_desk_full_or_a_number(text: str, budget: object) -> None:
    assert parse_budget(text) == budget


@pytest.mark.parametrize("text", ["0", "-5", "", "Desk", "1.5", "1e3", "many"])
def test_what_is_no_budget_is_refused_with_the_forms(text: str) -> None:
    with pytest.raises(UsageError, match=r"--budget.*expected desk, full or a number"):
        parse_budget(text)


def test_a_cell_stops_where_its_card_or_the_number_says() -> None:
    cell = cells(load_card("nav"), "solar", [0], "smoke")[0]
    smoke = load_card("nav").tables["variants"]["smoke"]["methods"]["solar"]["budget"]
    assert cell.budget("desk") == smoke["desk"]
    assert cell.budget("full") == smoke["full"]
    assert cell.budget(77) == 77


@pytest.mark.parametrize(
    ("variant", "sets", "label", "name"),
    [
        ("default", [], None, "default"),
        ("paper", [], None, "paper"),
        ("default", ["task.horizon=40"], None, "horizon-40"),
        ("paper", ["task.horizon=40"], None, "paper_horizon-40"),
        ("default", ["task.y=2", "task.x=1"], None, "x-1_y-2"),
        ("default", ["task.horizon=40"], "short", "short"),
        ("paper", [], "mine", "mine"),
    ],
)
def test_a_variant_is_named_after_what_it_changes_or_by_its_label(
    variant: str, sets: list[str], label: str | None, name: str
) -> None:
    assert variant_name(variant, sets, label) == name


@pytest.mark.parametrize("label", ["", "Short", "a b", "a/b", "a:b", "../x", "-x", "default"])
def test_a_label_that_is_no_name_is_refused(label: str) -> None:
    with pytest.raises(UsageError, match="--label"):
        variant_name("default", [], label)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (["task.x=1"], ["task.x=-1"]),
        (["task.x=1"], ["task.y=1"]),
        (["task.x=[1]"], ["task.x=[-1]"]),
        (["task.x=[1, 2]"], ["task.x=[12]"]),
        (["task.x=0.1"], ["task.x=0.01"]),
        (["task.x=1e-3"], ["task.x=1e3"]),
        (["task.observation.width=8"], ["methods.solar.cost_fit.width=8"]),
    ],
)
def test_different_changes_have_different_names(one: list[str], other: list[str]) -> None:
    """A curve pools the cells of one variant name: two changes under one name would be mixed."""
    assert variant_name("default", one, None) != variant_name("default", other, None)


def test_a_change_of_another_method_does_not_rename_the_variant() -> None:
    """``--method solar --method vae --set methods.vae...`` leaves solar's cells what they were."""
    card, change = load_card("nav"), ["methods.vae.training.steps=5"]
    assert cells(card, "solar", [0], sets=change) == cells(card, "solar", [0])
    assert cells(card, "vae", [0], sets=change)[0].variant != "default"


def test_a_variants_name_can_be_named_in_compare() -> None:
    """``solar compare solar:VARIANT`` splits at the colon."""
    name = variant_name("default", ['task.parameters."odd key:"="a:b C"'], None)
    assert not set(name) & set(": /\\\"'\n")
    assert name == name.lower()


def test_a_label_is_not_a_variant_of_the_card() -> None:
    card = load_card("nav")
    for label in ("default", "paper"):
        with pytest.raises(UsageError, match="choose another label"):
            cells(card, "solar", [0], "smoke", ["task.horizon=9"], label)


def test_long_names_are_cut_and_stay_apart() -> None:
    card = load_card("nav")
    long = [f"methods.solar.local_fit.widths={[1.0] * 30 + [last]}" for last in (2.0, 3.0)]
    names = [cells(card, "solar", [0], sets=[text])[0].variant for text in long]
    assert len(set(names)) == 2
    assert max(map(len, names)) == 60
    with pytest.raises(UsageError, match="at most 60"):
        cells(card, "solar", [0], sets=["task.horizon=9"], label="a" * 61)
