"""``solar run`` on the smoke variant, with a worker that can be told to die.

python drive.py DATABASE TASK SEEDS CHECKPOINT_SECONDS RESULTS.json [PATH=VALUE]...
"""

import json
import os
import sys
from pathlib import Path

from solar_cli.experiment.engine import LocalEngine
from solar_cli.experiment.matrix import plan
from solar_cli.experiment.scheduler import run
from solar_cli.settings import cells, load_card
from solar_cli.settings import method as registered
from solar_cli.settings.local import LatentMethod
from solar_cli.settings.registry import settings_class
from solar_cli.store.store import Store

method = os.environ["METHOD"]
# The encoder moves in every iteration, so that each has pulses and an update that depends on it.
MOVING = [f"methods.{method}.training.{text}" for text in ("steps=60", "fine_tune_steps=40")]

database, task, seeds, checkpoint_seconds, out, *sets = sys.argv[1:]
worker = Path(__file__).parent / "mortal_worker.py"
engine = LocalEngine([sys.executable, str(worker)]) if os.environ["DIE"] else LocalEngine()
changes = [*(MOVING if issubclass(settings_class(registered(method)), LatentMethod) else []), *sets]
wanted = cells(
    load_card(task), method, range(int(seeds)), "smoke", changes, "kills" if changes else None
)
with Store.open(database) as store:
    results = run(
        plan(store, wanted, "desk"),  # three iterations
        store,
        engine=engine,
        workers=2,
        device="cpu",
        checkpoint_seconds=float(checkpoint_seconds),
    )
summary = [
    {"cell": result.plan.cell.hash, "finished": result.finished, "cause": result.cause}
    for result in results
]
Path(out).write_text(json.dumps(summary))
sys.exit(not all(result.finished for result in results))
