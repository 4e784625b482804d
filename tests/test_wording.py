"""Sentences count in the singular and in the plural."""

from solar_cli.wording import counted, plural


def test_only_one_is_singular() -> None:
    counts = [counted(count, "episode") for count in (0, 1, 2, 21)]
    assert counts == ["0 episodes", "1 episode", "2 episodes", "21 episodes"]
    assert [plural("seed", count) for count in (0, 1, 2)] == ["seeds", "seed", "seeds"]
