"""One attempt at one cell: whatever interrupts it, the results are those of a quiet run."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import fake_method
import numpy as np
import pytest
from bits import OF_THE_MACHINE, files_of, fingerprint, metric_digest, state_digest
from collected_episodes import collected_in

from solar_cli.envs.task import RowTask
from solar_cli.errors import LostFiles, SolarError
from solar_cli.experience import Environment
from solar_cli.experiment import checkpointing, session
from solar_cli.experiment.judge import Judge
from solar_cli.experiment.messages import Message
from solar_cli.experiment.session import Session, Stopped
from solar_cli.methods import Diverged
from solar_cli.settings import Cell, cells, load_card
from solar_cli.store.owner import Owner
from solar_cli.store.records import Fenced, Outcome
from solar_cli.store.store import Store

TARGET = 12  # three iterations of the fake method


class Killed(BaseException):
    """Stands for kill -9: nothing of ours catches it."""


class Boss:
    """A supervisor that stops or kills at the n-th thing it hears, or hears of an activity."""

    def __init__(
        self, stop_at: int | None = None, kill_at: int | None = None, activity: str = ""
    ) -> None:
        self.stop_at, self.kill_at, self.activity = stop_at, kill_at, activity
        self.heard: list[Message] = []
        self.stopping = False

    def tell(self, message: Message) -> None:
        self.heard.append(message)
        heard = len(self.of(self.activity))
        if heard == self.kill_at:
            raise Killed
        self.stopping = self.stopping or heard == self.stop_at

    def of(self, activity: str) -> list[Message]:
        return [m for m in self.heard if activity in ("", m.activity)]


def attempt(
    store: Store, cell: Cell, boss: Boss | None = None, target: int = TARGET, every: float = 0.0
) -> Session:
    """Claim and run, as a worker does; ``every`` second inside an iteration a checkpoint."""
    store.add([cell])
    number = store.claim(cell.hash, Owner.current(), target, {})
    made = Session(
        store, cell, number, target, boss or Boss(), device="cpu", checkpoint_seconds=every
    )
    try:
        made.run()
    except BaseException:
        # What the next scheduler finds of an owner that is gone; this process lives on.
        store.end(cell.hash, number, Outcome.INTERRUPTED)
        raise
    store.end(cell.hash, number, Outcome.FINISHED)
    return made


@pytest.fixture
def cell(make_cells: Callable[..., list[Cell]]) -> Cell:
    return make_cells()[0]


@pytest.fixture(scope="session")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Cell], dict[str, str]]:
    """The fingerprint of a run that nothing interrupts, and that makes no checkpoints inside."""
    known: dict[str, dict[str, str]] = {}

    def of(cell: Cell) -> dict[str, str]:
        if cell.hash not in known:
            folder = tmp_path_factory.mktemp("quiet")
            with Store.open(str(folder / "solar.db")) as store:
                attempt(store, cell, every=1e9)
                known[cell.hash] = fingerprint(store, cell.hash)
        return known[cell.hash]

    return of


def test_each_iteration_has_metrics_of_learning_evaluation_and_model(
    store: Store, cell: Cell
) -> None:
    attempt(store, cell)
    rows = store.metrics(hashes=[cell.hash], values=True)
    found = {(row["iteration"], row["split"], row["name"]) for row in rows}
    for iteration, episodes in enumerate((0, 4, 8, 12)):
        assert (iteration, "noise_free", "return") in found
        assert (iteration, "noise_free", "final_distance") in found
        for split, name in (("train", "norm"), ("train", "return"), ("model", "frames")):
            assert ((iteration, split, name) in found) == (iteration > 0)
        assert {r["episodes"] for r in rows if r["iteration"] == iteration} == {episodes}
    judged = [row for row in rows if row["split"] == "noise_free"]
    assert all(len(row["values"]) == 8 for row in judged)  # the smoke variant's evaluation
    assert all(row["value"] == row["values"].mean() for row in judged)
    record = store.find(cell.hash)
    assert (record.iteration, record.episodes, record.steps) == (3, 12, 12 * 10)


def test_a_kill_at_any_moment_changes_no_bit(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    # Every message is a moment to die at: pulses, steps of a simulator, before commits.
    moments = set()
    kills = 0
    while True:
        boss = Boss(kill_at=2 + 2 * kills)  # later every time, or it would never get on
        try:
            attempt(store, cell, boss)
            break
        except Killed:
            kills += 1
            moments.add(boss.heard[-1].activity)
    assert kills >= 10
    assert moments >= {"collecting", "walking", "evaluating", "saving"}
    assert fingerprint(store, cell.hash) == quiet(cell)


@pytest.mark.parametrize("moment", ["save", "commit", "committed", "forget", "exhibit"])
def test_a_kill_around_a_commit_changes_no_bit(
    store: Store,
    cell: Cell,
    quiet: Callable[[Cell], dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    moment: str,
) -> None:
    places: dict[str, tuple[Any, str, bool]] = {
        "save": (checkpointing, "save", True),  # the file is renamed, the row is missing
        "commit": (Store, "commit", False),
        "committed": (Store, "commit", True),
        "forget": (Store, "forget_checkpoints", True),
        "exhibit": (session, "exhibit", False),
    }
    owner, name, after = places[moment]
    whole = getattr(owner, name)
    for nth in range(1, 2 if moment == "exhibit" else 5):  # of 13 commits, 10 at the most
        calls = 0

        def killing(*args: Any, nth: int = nth, **kwargs: Any) -> Any:
            nonlocal calls
            calls += 1
            result = whole(*args, **kwargs) if after or calls < nth else None
            if calls == nth:
                raise Killed
            return result

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, killing)
            with pytest.raises(Killed):
                attempt(store, cell)
    attempt(store, cell)
    assert fingerprint(store, cell.hash) == quiet(cell)
    records = store.checkpoints(cell.hash)
    assert files_of(store, cell.hash) == {store.folder(cell.hash) / r.path for r in records}
    assert {artifact.kind for artifact in store.artifacts(cell.hash)} == {
        "animation",
        "reconstruction",
        "latents",
    }


def test_a_stop_saves_where_it_stands_and_the_next_attempt_goes_on_there(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    boss = Boss(stop_at=4, activity="walking")
    with pytest.raises(Stopped):
        attempt(store, cell, boss, every=1e9)
    newest = store.checkpoints(cell.hash)[0]
    assert (newest.iteration, newest.complete) == (2, False)
    later = Boss()
    attempt(store, cell, later, every=1e9)
    pulses = boss.of("walking") + later.of("walking")
    assert len(pulses) == 9  # three iterations of three steps: none was done twice
    assert fingerprint(store, cell.hash) == quiet(cell)


STEPS = 11  # messages of episodes that run from their reset to the tenth action


@pytest.mark.parametrize("activity", ["collecting", "evaluating"])
@pytest.mark.parametrize("step", range(1, 3 * STEPS + 1, 5))
def test_a_stop_among_episodes_takes_one_step_and_costs_no_others(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]], activity: str, step: int
) -> None:
    boss = Boss(stop_at=step, activity=activity)
    with pytest.raises(Stopped):
        attempt(store, cell, boss, every=1e9)
    assert len(boss.of(activity)) == step
    later = Boss()
    attempt(store, cell, later, every=1e9)
    again = (step - 1) % STEPS + 1
    for made in ("collecting", "evaluating", "walking"):
        once = {"collecting": 3 * STEPS, "evaluating": 4 * STEPS, "walking": 9}[made]
        assert len(boss.of(made) + later.of(made)) == once + (again if made == activity else 0)
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_a_kill_late_in_a_long_evaluation_costs_the_evaluation_only(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    boss = Boss(kill_at=3 * STEPS, activity="evaluating")  # of iteration 2
    with pytest.raises(Killed):
        attempt(store, cell, boss, every=0.0)
    later = Boss()
    attempt(store, cell, later, every=0.0)
    assert later.heard[1].activity == "evaluating"  # the first after "restoring"
    assert len(boss.of("walking") + later.of("walking")) == 9
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_a_stop_before_anything_was_collected_leaves_the_last_iteration_complete(
    store: Store, cell: Cell
) -> None:
    attempt(store, cell, target=4)
    with pytest.raises(Stopped):
        attempt(store, cell, Boss(stop_at=5, activity="collecting"), every=0.0)
    assert store.checkpoints(cell.hash)[0].complete
    later = Boss()
    attempt(store, cell, later, target=4)
    assert not later.of("collecting")


def test_more_episodes_continue_a_finished_cell(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    attempt(store, cell, target=4)
    attempt(store, cell, target=TARGET)
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_a_finished_cell_is_not_computed_again(store: Store, cell: Cell) -> None:
    attempt(store, cell)
    before = fingerprint(store, cell.hash)
    boss = Boss()
    attempt(store, cell, boss)
    assert not boss.of("collecting") + boss.of("walking") + boss.of("saving")
    assert fingerprint(store, cell.hash) == before


def test_seconds_of_computing_add_up_over_attempts(store: Store, cell: Cell) -> None:
    attempt(store, cell, target=4)
    first = store.find(cell.hash).seconds
    attempt(store, cell)
    assert store.find(cell.hash).seconds > first > 0


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def remove(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("damage", [truncate, flip, remove])
def test_the_checkpoint_before_a_damaged_one_is_used(
    store: Store,
    cell: Cell,
    quiet: Callable[[Cell], dict[str, str]],
    damage: Callable[[Path], None],
) -> None:
    attempt(store, cell, target=8, every=1e9)
    newest, before = store.checkpoints(cell.hash)[:2]
    damage(store.folder(cell.hash) / newest.path)
    boss = Boss()
    made = attempt(store, cell, boss, every=1e9)
    assert len(made.notes) == 1
    assert newest.path in made.notes[0]
    assert boss.heard[1].iteration == before.iteration + 1  # the first after "restoring"
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_without_a_sound_checkpoint_nothing_that_was_evaluated_is_discarded(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    attempt(store, cell, target=8)
    kept, rows = store.checkpoints(cell.hash), store.metrics(hashes=[cell.hash])
    sound = {path: path.read_bytes() for path in files_of(store, cell.hash)}
    for path in sound:
        flip(path)
    for _ in range(2):
        with pytest.raises(LostFiles, match=r"0002-.*\.pt.*--redo"):
            attempt(store, cell)
        assert store.checkpoints(cell.hash) == kept
        assert store.metrics(hashes=[cell.hash]) == rows
    restored = store.folder(cell.hash) / kept[1].path
    restored.write_bytes(sound[restored])
    attempt(store, cell)
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_without_a_sound_checkpoint_a_first_iteration_starts_anew_and_says_so(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    with pytest.raises(Stopped):
        attempt(store, cell, Boss(stop_at=2, activity="walking"))
    records = store.checkpoints(cell.hash)
    for record in records:
        flip(store.folder(cell.hash) / record.path)
    made = attempt(store, cell)
    assert len(made.notes) == len(records)
    assert all("anew" in note for note in made.notes)
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_episode_files_that_are_lost_after_a_kill_are_collected_again(
    store: Store, cell: Cell, quiet: Callable[[Cell], dict[str, str]]
) -> None:
    boss = Boss(kill_at=1, activity="walking")  # collected, not yet in a checkpoint
    with pytest.raises(Killed):
        attempt(store, cell, boss, every=1e9)
    for path in (store.folder(cell.hash) / "episodes").iterdir():
        flip(path)
    attempt(store, cell)
    assert fingerprint(store, cell.hash) == quiet(cell)


def test_a_checkpoint_that_does_not_fit_the_code_says_what_to_do(
    store: Store, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt(store, cell, target=4)

    def refuse(self: Any, state: dict[str, Any]) -> None:
        raise KeyError("bias")

    monkeypatch.setattr(fake_method.Fake, "load_state_dict", refuse)
    with pytest.raises(SolarError, match="--redo"):
        attempt(store, cell)


@pytest.mark.parametrize(("every", "kept"), [(1e9, [8, 7, 3]), (0.0, [8, 8, 3])])
def test_two_newest_checkpoints_and_the_best_by_training_cost_are_kept(
    store: Store, cell: Cell, monkeypatch: pytest.MonkeyPatch, every: float, kept: list[int]
) -> None:
    def best_at_four(self: Environment, iteration: int) -> dict[str, float]:
        return {"return": -abs(iteration - 4.0)}

    monkeypatch.setattr(Environment, "summary", best_at_four)
    attempt(store, cell, target=32, every=every)
    # Iteration 4 is collected by the policy of the checkpoint of iteration 3.
    records = store.checkpoints(cell.hash)
    assert [record.iteration for record in records] == kept
    assert files_of(store, cell.hash) == {store.folder(cell.hash) / r.path for r in records}


def test_the_first_checkpoint_at_each_milestone_of_the_card_is_kept(
    store: Store, cell: Cell
) -> None:
    card = load_card("nav")
    tables = {**card.tables["evaluation"], "milestones": [4, 10, 18, 1000]}
    marked = replace(card, tables={**card.tables, "evaluation": tables})
    [kept] = cells(marked, "fake", [0], "smoke")
    assert kept.hash == cell.hash  # milestones name no other cell
    for _ in range(9):  # killed within every iteration, saved at every pulse
        with suppress(Killed):
            attempt(store, kept, Boss(kill_at=9), target=32)
    attempt(store, kept, target=32)
    best = checkpointing.best_iteration(store, kept.hash)
    records = store.checkpoints(kept.hash)
    # Four episodes an iteration: 4 are reached in iteration 1, 10 in 3, 18 in 5, 1000 not yet.
    assert {r.iteration for r in records if r.complete} == {1, 3, 5, 8} | {best}
    assert [record.episodes for record in records if record.iteration in (1, 3, 5)] == [20, 12, 4]
    assert files_of(store, kept.hash) == {store.folder(kept.hash) / r.path for r in records}


def test_evaluation_episodes_are_none_that_were_learned_from(store: Store, cell: Cell) -> None:
    made = attempt(store, cell, every=1e9)
    judge, policy = Judge(cell), made.learner.policy
    collected = [collected_in(iteration, made.environment)[0] for iteration in (1, 2)]
    judged = [judge.evaluate(policy, iteration).episodes for iteration in (0, 1, 2)]
    starts = [episodes.frames[i, 0].tobytes() for episodes in (*collected, *judged) for i in (0, 1)]
    assert len(set(starts)) == len(starts)
    again = judge.evaluate(policy, 1).episodes
    np.testing.assert_array_equal(again.frames, judged[1].frames)


@pytest.mark.parametrize(("trouble", "word"), [("diverge", "told to"), ("nan", "evaluation")])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_divergence_ends_the_attempt_and_keeps_what_came_before(
    store: Store, make_cells: Callable[..., list[Cell]], trouble: str, word: str
) -> None:
    cell = make_cells(trouble=trouble)[0]
    with pytest.raises(Diverged, match=word):
        attempt(store, cell)
    rows = store.metrics(hashes=[cell.hash])
    assert {row["iteration"] for row in rows} <= {0, 1}
    assert {row["kind"] for row in rows} == {"finite"}


def test_an_attempt_that_was_taken_over_writes_nothing(store: Store, cell: Cell) -> None:
    def take_over(message: Message) -> None:
        if message.iteration == 2 and message.activity == "walking":
            store.end(cell.hash, 1, Outcome.INTERRUPTED)
            store.claim(cell.hash, Owner.current(), TARGET, {})

    boss = Boss()
    boss.tell = take_over  # type: ignore[method-assign]
    store.add([cell])
    number = store.claim(cell.hash, Owner.current(), TARGET, {})
    late = Session(store, cell, number, TARGET, boss, device="cpu", checkpoint_seconds=1e9)
    with pytest.raises(Fenced):
        late.run()
    assert {row["iteration"] for row in store.metrics(hashes=[cell.hash])} == {0, 1}
    assert store.checkpoints(cell.hash)[0].iteration == 1


def learned(store: Store, cell: Cell) -> tuple[str, str]:
    """What may not depend on evaluations: the learner's state, and what it learned from."""
    return state_digest(store, cell.hash), metric_digest(store, cell.hash, ("train",))


@pytest.mark.parametrize("method", ["fake", "solar"])
def test_evaluating_never_once_or_ten_times_gives_the_same_policy(
    tmp_path: Path,
    make_cells: Callable[..., list[Cell]],
    monkeypatch: pytest.MonkeyPatch,
    method: str,
) -> None:
    cell = make_cells(method=method)[0]
    whole = Judge.evaluate
    idle = Judge(cell).evaluate(still(cell), 0)

    def never(self: Judge, policy: Any, iteration: int) -> Any:
        return idle

    def ten_times(self: Judge, policy: Any, iteration: int) -> Any:
        return [whole(self, policy, iteration) for _ in range(10)][-1]

    found = []
    for name, evaluate in (("never", never), ("once", whole), ("ten", ten_times)):
        monkeypatch.setattr(Judge, "evaluate", evaluate)
        with Store.open(str(tmp_path / f"{name}.db")) as store:
            attempt(store, cell, every=1e9)
            found.append(learned(store, cell))
    assert found[0] == found[1] == found[2]


def still(cell: Cell) -> Any:
    """A policy that does nothing."""

    class Still:
        def start(self, episodes: int, stream: Any) -> None: ...

        def act(self, observations: Any, t: int, state: Any) -> Any:
            zeros = np.zeros((len(observations), cell.configuration.task.action.size))
            return zeros, zeros, state

    return Still()


@pytest.mark.parametrize("method", ["fake", "solar"])
@pytest.mark.filterwarnings("ignore:ground truth is missing")
def test_measures_that_raise_change_nothing_that_is_learned(
    tmp_path: Path,
    make_cells: Callable[..., list[Cell]],
    monkeypatch: pytest.MonkeyPatch,
    method: str,
) -> None:
    cell = make_cells(method=method)[0]

    def raising(self: RowTask) -> Any:
        raise RuntimeError("out of reach")

    found = []
    for name in ("measured", "blind"):
        if name == "blind":
            monkeypatch.setattr(RowTask, "measures", raising)
        with Store.open(str(tmp_path / f"{name}.db")) as store:
            attempt(store, cell, every=1e9)
            names = {row["name"] for row in store.metrics(hashes=[cell.hash])}
            assert ("final_distance" in names) == (name == "measured")
            rows = store.metrics(hashes=[cell.hash], splits=["train"])
            kept = [
                (row["iteration"], row["name"], row["value"])
                for row in rows
                if "distance" not in row["name"] and not row["name"].startswith(OF_THE_MACHINE)
            ]
            found.append((kept, state_digest(store, cell.hash, ("learner",))))
    assert found[0] == found[1]
