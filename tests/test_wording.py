"""Sentences count in the singular and in the plural, and tell no password."""

import pytest

from solar_cli.wording import counted, plural, without_password


def test_only_one_is_singular() -> None:
    counts = [counted(count, "episode") for count in (0, 1, 2, 21)]
    assert counts == ["0 episodes", "1 episode", "2 episodes", "21 episodes"]
    assert [plural("seed", count) for count in (0, 1, 2)] == ["seeds", "seed", "seeds"]


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("postgresql://me:secret@host:5432/db", "postgresql://me:***@host:5432/db"),
        ("postgresql://me:s ec/r:et@host/db", "postgresql://me:***@host/db"),
        ("postgresql://:secret@host/db", "postgresql://:***@host/db"),
        (
            "postgresql://host/db?user=me&password=secret",
            "postgresql://host/db?user=me&password=***",
        ),
        ("postgresql://host/db?password=sec@ret&a=b", "postgresql://host/db?password=***&a=b"),
        *((same, same) for same in ("postgresql://me@host:5432/db", "sqlite:////a:b@c/d", "a/b:c")),
    ],
)
def test_a_password_is_left_out_of_an_address(address: str, shown: str) -> None:
    assert without_password(address) == shown
    assert without_password(f"--db={address}") == f"--db={shown}"
