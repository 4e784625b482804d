"""The command as a whole: fast, documented, one way of failing."""

import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from scenario import Solar, Stored

from solar_cli import cli
from solar_cli.errors import SolarError

README = Path(__file__).parent.parent.parent / "README.md"
HEAVY = ("torch", "scipy", "matplotlib", "pandas", "gymnasium", "mujoco")
HEAVY += ("stable_baselines3", "sb3_contrib")
LESS = ("sqlalchemy", "numpy", "rich")  # what a database takes, a task, a table
SMOKE = ("--task", "nav", "--method", "solar", "--variant", "smoke")
COMMANDS = sorted(command.name for command in cli.app.registered_commands if command.name)


def test_the_commands_are_those_of_the_design() -> None:
    named = {"run", "status", "show", "report", "compare", "tasks", "methods", "export", "rm"}
    assert set(COMMANDS) == named | {"diagnose", "doctor"}


def examples(text: str) -> list[str]:
    return re.findall(r"^ +(solar [a-z]+.*?) *$", text, re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example_that_parses(solar: Solar, command: str) -> None:
    done = solar(command, "--help")
    assert done.code == 0
    assert "--db" in done.out
    assert "Example:" in done.out
    [example] = examples(done.out)
    assert example.split()[:2] == ["solar", command]
    # parsed and understood as far as a database that does not exist
    failed = solar(*example.split()[1:], "--db", "absent/dir/none.db", "--help")
    assert failed.code == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_in_the_readme(command: str) -> None:
    assert re.search(rf"^solar {command}\b", README.read_text(), re.MULTILINE)


def test_every_command_of_the_readme_exists_with_its_options(solar: Solar) -> None:
    text = README.read_text()
    found = re.findall(r"^solar ([a-z]+)(.*?)(?:#.*)?$", text, re.MULTILINE)
    assert len(found) >= len(COMMANDS)
    for command, rest in found:
        assert command in COMMANDS
        help_text = solar(command, "--help").out
        for option in re.findall(r"--[a-z-]+", rest):
            assert option in help_text, f"solar {command} {option}"


def run_python(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


def imported(arguments: list[str], folder: Path) -> set[str]:
    """Heavy modules that a command has imported when it is done."""
    program = (
        "import os, sys; from solar_cli.cli import main;"
        f"os.chdir({str(folder)!r}); code = main({arguments!r});"
        f"print('HEAVY', code, *[name for name in {(*HEAVY, *LESS)} if name in sys.modules])"
    )
    done = run_python(program)
    last = done.stdout.splitlines()[-1].split()
    assert last[:2] == ["HEAVY", "0"], done
    return set(last[2:])


def test_help_imports_nothing_heavy(tmp_path: Path) -> None:
    assert imported(["--help"], tmp_path) == {"rich"}
    assert imported(["run", "--help"], tmp_path) == {"rich"}
    assert imported(["tasks"], tmp_path) == {"rich"}
    assert imported(["methods", "solar"], tmp_path) == {"rich"}


@pytest.mark.parametrize(
    ("arguments", "besides"),
    [
        (["status"], {"rich"}),
        (["show", "{cell}"], {"rich"}),
        (["run", *SMOKE, "--seeds", "3"], set()),
        (["run", *SMOKE, "--seeds", "9", "--dry-run"], {"numpy", "rich"}),
        (["run", *SMOKE, "--device", "cuda"], set()),
    ],
    ids=["status", "show", "run", "dry run", "run on a GPU"],
)
def test_looking_at_a_matrix_imports_nothing_heavy(
    stored: Stored, tmp_path: Path, arguments: list[str], besides: set[str]
) -> None:
    """Cells that are to be computed have their task tried; a GPU is not looked for without any."""
    told = [argument.format(cell=stored.finished.hash) for argument in arguments]
    assert imported([*told, "--db", str(stored.db)], tmp_path) == {"sqlalchemy", *besides}


def test_a_preview_imports_nothing_that_learns(tmp_path: Path) -> None:
    assert imported(["tasks", "nav", "--preview", "nav.gif"], tmp_path) == {"numpy"}


def test_help_is_there_at_once() -> None:
    """Processor time, because that of the clock depends on who else is computing."""

    def seconds() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert run_python("from solar_cli.cli import main; main(['--help'])").returncode == 0
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    assert min(seconds() for _ in range(3)) < 0.5


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (SolarError("it broke [red]\x1b[1m\nhere"), 1, "solar: it broke [red][1m here\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_an_error_is_one_line_and_its_exit_code(
    solar: Solar, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, said: str
) -> None:
    from solar_cli import settings

    def fail() -> list[str]:
        raise error

    monkeypatch.setattr(settings, "card_names", fail)
    done = solar("tasks")
    assert (done.code, done.err) == (code, said)


@pytest.mark.parametrize("command", ["methods --json", "tasks nav"])
def test_a_reader_that_leaves_early_is_met_with_silence(command: str) -> None:
    """Both ends: output that waits for the last flush, and output that is written before it."""
    program = "import sys; from solar_cli.cli import main; sys.exit(main())"
    pipeline = f'"$0" -c "$1" {command} | true; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(
        ["bash", "-c", pipeline, sys.executable, program],
        capture_output=True,
        text=True,
        check=False,
        env={key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"},
    )
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize(
    ("command", "closed", "code"),
    [("methods", ">&-", 0), ("methods --json", ">&-", 0), ("tasks absent", "2>&-", 2)],
)
def test_a_closed_stream_is_written_to_in_silence(command: str, closed: str, code: int) -> None:
    program = "import sys; from solar_cli.cli import main; sys.exit(main())"
    done = subprocess.run(
        ["bash", "-c", f'"$0" -c "$1" {command} {closed}', sys.executable, program],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


def complete(line: str) -> str:
    """What bash would offer for a command line; its last word is being typed."""
    program = "import sys; from solar_cli.cli import main; sys.exit(main([]))"
    environment = {
        "_SOLAR_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split(" ")) - 1),
    }
    return run_python(program, **environment).stdout


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("solar run --task na", {"nav", "nav-fixed"}),
        ("solar run --task nav --method so", {"solar"}),
        ("solar status --variant sm", {"smoke", "smoother"}),
        ("solar tasks nav-", {"nav-fixed"}),
    ],
)
def test_the_shell_completes_names_of_tasks_methods_and_variants(
    line: str, offered: set[str]
) -> None:
    assert set(complete(line).split()) == offered


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("command", ["status", "tasks", "tasks --json", "export", "methods"])
def test_output_that_cannot_be_written_is_one_line(stored: Stored, command: str) -> None:
    program = "import sys; from solar_cli.cli import main; sys.exit(main())"
    pipeline = f'"$0" -c "$1" {command} --db "$2" > /dev/full'
    done = subprocess.run(
        ["bash", "-c", pipeline, sys.executable, program, str(stored.db)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done
    assert "standard output" in done.stderr


def test_a_cell_shown_to_a_reader_that_has_left_is_met_with_silence(stored: Stored) -> None:
    program = "import sys; from solar_cli.cli import main; sys.exit(main())"
    pipeline = f'"$0" -c "$1" show {stored.finished.hash} --db "$2" | true; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(
        ["bash", "-c", pipeline, sys.executable, program, str(stored.db)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (1, "")
