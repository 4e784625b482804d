"""A checkpoint that the disk has damaged is noticed, and the one before it gives the same bits."""

from collections.abc import Callable
from pathlib import Path

import pytest
from disturbed import Matrix, Undisturbed

from solar_cli.store.store import Store


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


def flip_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 16
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, Path.unlink])
def test_the_checkpoint_before_a_damaged_one_is_used(
    matrix: Callable[[int], Matrix],
    undisturbed: Undisturbed,
    damage: Callable[[Path], None],
) -> None:
    run = matrix(1)
    run.die("evaluating:24:both")  # the evaluation of iteration 2, of ten steps as all
    with Store.open(run.db) as store:
        [record] = store.cells()
        newest, before, *_ = store.checkpoints(record.hash)
        assert (before.iteration, newest.iteration) == (2, 2)
        damage(store.folder(record.hash) / newest.path)
    [result] = run.finish()
    assert result["finished"]
    assert newest.path in result["cause"]  # said, though all went well
    assert run.fingerprints()[record.hash] == undisturbed.fingerprints[record.hash]
