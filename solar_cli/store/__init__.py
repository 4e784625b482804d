"""The store: the database of cells, attempts, metrics and artifacts, and the cells' files.

``store.store`` has the `Store`, ``store.records`` what it takes, hands out and raises, and
``store.checkpoints`` the files that a run continues from. Nothing is imported here, so that the
parts which need no database stay quick to load.
"""
