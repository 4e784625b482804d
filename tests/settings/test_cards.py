"""Cards, variants and --set combine in one order, and every mistake is one helpful line."""

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from solar_cli.errors import UsageError
from solar_cli.settings import card_names, load_card, method, method_names, resolve

CARD = """
summary = "A toy."
[task]
simulator = "navigation"
horizon = 50
observation = {{ kind = "image", height = 32, width = 32, channels = 2 }}
action = {{ size = 2, bound = 1.0 }}
exploration = {{ std = 0.1 }}
[methods.solar]
batches = {{ initial = 60, noisy = 20 }}
budget = {{ desk = 240, full = 400 }}
[variants.long]
task.horizon = 90
{more}
"""


def toy(folder: Path, more: str = "") -> Path:
    path = folder / "toy.toml"
    path.write_text(CARD.format(more=more))
    return path


@pytest.mark.parametrize("task", card_names())
def test_every_card_resolves_for_each_of_its_methods_and_variants(task: str) -> None:
    card = load_card(task)
    for name in set(card.tables["methods"]) & set(method_names()):
        if card.task.observation.kind not in method(name).observations:  # of a card it extends
            with pytest.raises(UsageError, match=f"{name}.* observations"):
                resolve(card, name)
            continue
        assert resolve(card, name).configuration.task.horizon >= 1
        for variant, changes in card.tables["variants"].items():
            if name in changes.get("methods", {}) or set(changes) - {"methods"}:
                assert resolve(card, name, variant).configuration.task.horizon >= 1
            else:
                with pytest.raises(UsageError, match="changes nothing"):
                    resolve(card, name, variant)


def test_a_card_extends_another(tmp_path: Path) -> None:
    base = load_card(str(toy(tmp_path)))
    path = tmp_path / "other.toml"
    path.write_text('extends = "toy"\nsummary = "Other."\n[task]\nhorizon = 7\n')
    other = load_card(str(path))
    assert (other.name, other.summary, other.task.horizon) == ("other", "Other.", 7)
    assert other.task.action == base.task.action
    for wrong in ('"none-such"', '"other"', "3"):
        path.write_text(f"extends = {wrong}")
        check(lambda: load_card(str(path)), [str(path), "extends"])


def test_a_method_can_be_like_another_one(tmp_path: Path) -> None:
    card = load_card("nav")
    solar, vae = (resolve(card, name).configuration.method for name in ("solar", "vae"))
    assert vae.representation == solar.representation
    assert vae.local_fit.method == "gmm"  # its own default stands
    path = toy(tmp_path, '[methods.vae]\nlike = "slar"')
    check(lambda: load_card(str(path)), ["methods.vae.like", "solar"])
    like = '[methods.vae]\nlike = "solar"\n[variants.long.methods.vae]\nlike = "slar"'
    path = toy(tmp_path, like)
    check(lambda: load_card(str(path)), ["variants.long.methods.vae.like", "slar"])


def test_a_method_like_another_takes_what_both_have_in_a_card_and_in_its_variants() -> None:
    card = load_card("nav")
    for variant in ("default", "smoke"):
        solar, flm = (
            resolve(card, name, variant).configuration.method for name in ("solar", "lqr-flm")
        )
        assert (flm.batches, flm.budget) == (solar.batches, solar.budget)
        assert not hasattr(flm, "training")


def test_later_layers_win_and_each_value_knows_where_it_comes_from(tmp_path: Path) -> None:
    card = load_card(str(toy(tmp_path)))
    plain = resolve(card, "solar")
    assert plain.configuration.task.horizon == 50
    assert plain.origins["task.horizon"] == "card"
    assert "task.step_seconds" not in plain.origins  # a default

    long = resolve(card, "solar", "long")
    assert (long.configuration.task.horizon, long.origins["task.horizon"]) == (90, "variant long")

    told = resolve(card, "solar", "long", ["task.horizon=7"])
    assert (told.configuration.task.horizon, told.origins["task.horizon"]) == (7, "--set")


def test_a_set_of_one_method_leaves_the_others_alone() -> None:
    card, change = load_card("nav"), ["methods.solar.training.steps=5"]
    assert resolve(card, "vae", sets=change) == resolve(card, "vae")
    assert resolve(card, "solar", sets=change).configuration.method.training.steps == 5  # type: ignore[attr-defined]


def test_a_card_beside_the_work_wins_over_the_packaged_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "nav.toml").write_text(toy(tmp_path).read_text())
    monkeypatch.chdir(tmp_path)
    assert load_card("nav").summary == "A toy."


CARD_FAULTS = {
    "broken TOML": ("x = ", ["toy.toml", "line"]),
    "unknown key": ("[task2]\nx = 1", ["toy.toml", "'task2'", "did you mean 'task'"]),
    "unknown setting": (
        "[variants.v.methods.solar.training]\nstps = 1",
        ["toy", "variant 'v'", "'methods.solar.training.stps'", "did you mean 'steps'"],
    ),
    "ill-typed": (
        '[variants.v]\ntask.horizon = "nine"',
        ["toy", "'task.horizon'", "integer", "'nine'"],
    ),
    "out of range": ("[variants.v]\ntask.horizon = 0", ["'task.horizon'", "greater than", "0"]),
    "unknown layer": (
        '[variants.v.methods.solar.representation]\nencoder = [{ kind = "cnov" }]',
        ["encoder", "'cnov'", "'conv'"],
    ),
    "variant named as no file is": ('[variants."../A B"]\ntask.horizon = 3', ["'variants.../A B'"]),
    "variant named default": ("[variants.default]\ntask.horizon = 3", ["'variants.default'"]),
    "unknown path in a variant": ("[variants.v]\nhorizon = 3", ["variant v", "'horizon'", "task"]),
}


@pytest.mark.parametrize("fault", CARD_FAULTS)
def test_a_malformed_card_names_file_place_and_expectation(tmp_path: Path, fault: str) -> None:
    more, expected = CARD_FAULTS[fault]
    check(lambda: load_card(str(toy(tmp_path, more))), ["toy.toml", *expected])


def test_a_wrong_entry_is_one_mistake_and_a_table_is_called_so() -> None:
    def said(text: str) -> str:
        with pytest.raises(UsageError) as caught:
            resolve(load_card("nav"), "solar", "default", [text])
        return str(caught.value)

    encoder = "methods.solar.representation.encoder"
    assert "at least 1 item" not in said(f'{encoder}=[{{ kind = "conv" }}]')
    assert "at least 1 item" in said(f"{encoder}=[]")
    for path in ("task", "task.parameters", "methods.solar"):
        assert f"'{path}': Input should be a table, not 3" in said(f"{path}=3")


def test_a_card_that_misses_a_value_names_it(tmp_path: Path) -> None:
    path = toy(tmp_path)
    path.write_text(path.read_text().replace("horizon = 50\n", ""))
    check(lambda: load_card(str(path)), ["toy.toml", "'task.horizon'", "required"])


def test_a_card_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    check(lambda: load_card(str(tmp_path / "absent.toml")), ["absent.toml", "cannot be read"])
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    check(lambda: load_card(str(tmp_path / "bytes.toml")), ["bytes.toml", "cannot be read"])
    (tmp_path / "Upper Case.toml").write_text("")
    check(lambda: load_card(str(tmp_path / "Upper Case.toml")), ["lower-case", "rename"])


SET_FAULTS = {
    "task.horizon": ["PATH=VALUE"],
    "=3": ["PATH=VALUE"],
    "task..horizon=3": ["PATH=VALUE"],
    "task.horizon=": ["'task.horizon='", "TOML"],
    "task.horizon=ten": ["'ten'", "quotes"],
    "task.horizon=3\ntask.x=4": ["one value"],
    "task.horzon=3": ["'task.horzon'", "did you mean 'horizon'"],
    "horizon=3": ["'horizon'", "task, evaluation or methods"],
    'task.horizon="x"': ["'task.horizon'", "integer", "'x'"],
    "task.horizon=true": ["'task.horizon'", "a number", "True"],
    "task.horizon='3'": ["'task.horizon'", "a number", "'3'"],
    "task.action_cost=false": ["'task.action_cost'", "a number", "False"],
    "evaluation.levels=[0.5, true]": ["'evaluation.levels.1'", "a number", "True"],
    "methods.solar.update.kl_step=true": ["'methods.solar.update.kl_step'", "number", "True"],
    "methods.solar.update.linearise=1": ["'methods.solar.update.linearise'", "true or false", "1"],
    "evaluation.milestones=[0]": ["'evaluation.milestones.0'", "greater than", "0"],
    "task=3": ["'task'"],
    "methods=3": ["methods"],
    "methods.solar=3": ["'methods.solar'"],
    "methods.sola.training.steps=3": ["'sola'", "did you mean 'solar'"],
    "methods.solar.training.steps=0": ["'methods.solar.training.steps'", "greater than"],
    "task.exploration.std=inf": ["'task.exploration.std'", "finite"],
    "task.horizon=" + "9" * 5000: ["task.horizon"],
    "task.horizon=" + "[" * 5000: ["task.horizon"],
}


@pytest.mark.parametrize("text", SET_FAULTS, ids=lambda text: text[:32].replace("\n", " "))
def test_a_wrong_set_names_the_path_and_what_was_expected(text: str) -> None:
    check(lambda: resolve(load_card("nav"), "solar", "default", [text]), SET_FAULTS[text])


@pytest.mark.parametrize("given", [{}, {"height": 8}, {"width": 8}])
def test_an_image_needs_its_size(given: dict[str, int]) -> None:
    card = load_card("nav")
    card.tables["task"]["observation"] = {"kind": "image", "channels": 2, **given}
    check(lambda: resolve(card, "solar"), ["'task.observation'", "height and width"])


def test_unknown_names_offer_the_nearest() -> None:
    card = load_card("nav")
    check(lambda: load_card("nva"), ["'nva'", "did you mean 'nav'"])
    check(lambda: resolve(card, "sloar"), ["'sloar'", "did you mean 'solar'"])
    check(lambda: resolve(card, "solar", "papr"), ["'papr'", "did you mean 'paper'"])


def test_a_method_refuses_observations_it_cannot_learn_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import dataclasses

    from solar_cli.settings import card as module
    from solar_cli.settings import method

    blind = dataclasses.replace(method("solar"), observations=("state",))
    monkeypatch.setattr(module, "method", lambda name: blind)
    check(lambda: resolve(load_card("nav"), "solar"), ["'solar'", "state", "image"])


PARTS = ["task", "methods", "evaluation", "solar", "vae", "horizon", "training", "steps"]
MORE = ["parameters", "goal", "x", "observation", "representation", "encoder", "", " "]
PATHS = st.lists(st.sampled_from([*PARTS, *MORE]), max_size=5).map(".".join)
VALUES = st.one_of(
    st.text(max_size=20),
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(["true", "[]", "{}", "[1, {a = 2}]", "1979-05-27", '"x"', "'''", "1\n[x]"]),
)


@given(st.one_of(st.text(max_size=40), st.builds("{}={}".format, PATHS, VALUES)))
@example("methods=1")
@example('task.parameters."a.b"=1')
@settings(max_examples=300, deadline=None)
def test_whatever_is_set_either_works_or_is_a_usage_error(text: str) -> None:
    try:
        resolved = resolve(load_card("nav"), "solar", "default", [text])
    except UsageError as error:
        one_line(error)
    else:
        assert resolved.configuration.task.horizon >= 1


def check(subject: object, expected: list[str]) -> None:
    with pytest.raises(UsageError) as caught:
        subject()  # type: ignore[operator]
    one_line(caught.value)
    for part in expected:
        assert part in str(caught.value)


def one_line(error: UsageError) -> None:
    assert error.exit_code == 2
    assert "\n" not in str(error)


def test_a_card_does_not_undo_what_a_method_says_of_its_nested_settings() -> None:
    plain = resolve(load_card("nav"), "vae").configuration.method
    assert plain.training.standard_normal == 0.0  # though the card has a training table
    changed = resolve(load_card("nav"), "vae", sets=["methods.vae.local_fit.folds=2"])
    assert (changed.configuration.method.local_fit.method, plain.local_fit.method) == ("gmm", "gmm")
