"""The store: what was asked for, who computes it, what came out.

What holds at any moment, whichever process is killed:

* **Who may write.** A cell's newest attempt, until it has ended. `Store.claim` makes an attempt
  only when no live process has the cell, and every later write carries the attempt's number: a
  writer whose cell was taken over gets `Fenced` and changes nothing.
* **What is atomic.** Each method that writes is one transaction. `Store.commit` stores an
  iteration's metrics, the progress and the checkpoint that continues from there, together.
* **What a reader sees.** One snapshot a call. The rows of iteration k are of one attempt's commit
  of it; nothing lies beyond the newest commit. A cell whose process is gone reads ``interrupted``.
* **Files** lie in the cell's own folder. They are complete before a row names them, and are deleted
  only after no row names them.
"""

from __future__ import annotations

from solar_cli.store.address import locate
from solar_cli.store.attempts import Attempts
from solar_cli.store.cells import Cells
from solar_cli.store.migrate import open_database
from solar_cli.store.results import Results
from solar_cli.store.schema import HEAD


class Store(Cells, Attempts, Results):
    """One database and the files of its cells. Open with `Store.open`; a context manager."""

    @classmethod
    def open(cls, address: str | None = None, *, read_only: bool = False) -> Store:
        """Open the database at ``address``: a path, ``sqlite:///PATH`` or ``postgresql://...``.

        Without one it is ``SOLAR_DB``, else ``runs/solar.db``. A database that is not there, or is
        older, is created or upgraded, unless ``read_only``. Raises `UsageError` for what is no
        Solar database, is newer than this program, or cannot be written or reached.
        """
        location = locate(address)
        return cls(location, open_database(location, read_only=read_only))

    def diagnose(self) -> dict[str, str]:
        """What `solar doctor` says of the database; reads all of it once."""
        return {
            "address": str(self),
            "files": str(self.home),
            "schema": HEAD,
            **self._database.diagnose(),
        }
