"""The example notebook: its cells run, in a plain process and in a real kernel, and show what a user should see."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"


def test_it_is_small_and_holds_no_outputs() -> None:
    assert NOTEBOOK.stat().st_size < 10_000
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells if cell["cell_type"] == "code")


@pytest.mark.docs
def test_its_cells_run_as_a_program(tmp_path: Path) -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    program = "\n".join("".join(cell["source"]) for cell in cells)
    records = "\nprint(run.record('corridor/example-v0', steps=100))\n"
    done = subprocess.run(
        [sys.executable, "-c", program + records],
        cwd=tmp_path, env={**os.environ, "MINARI_DATASETS_PATH": str(tmp_path)},
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "dataset corridor/example-v0: 10" in done.stdout
    assert " env steps | " in done.stdout, "without a notebook, progress is lines"
    assert_it_walks_out(done.stdout)


def assert_it_walks_out(said: str) -> None:
    assert "actions at the ten places: [1 1 1 1 1 1 1 1 1" in said
    found = re.search(r"from place (\d+) to the exit in (\d+) steps", said)
    assert found is not None
    assert int(found[1]) + int(found[2]) == 9, "the shortest way"


def test_a_kernel_executes_it_and_shows_progress_table_and_curve(tmp_path: Path) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    _, train, evaluate, metrics, resume, act = [cell.outputs for cell in notebook.cells if cell.cell_type == "code"]
    shown, note, result = train
    assert note["name"] == "stdout", "the final evaluation is a line"
    assert "greedy return" in note["text"]
    assert "<progress max='8000'" in shown["data"]["text/html"], "one display, updated in place"
    assert "8,000 env steps | " in shown["data"]["text/plain"]
    assert "<td" in result["data"]["text/html"]
    assert evaluate[-1]["data"]["text/plain"].startswith("Evaluation(episodes=100, ")
    assert "updates, newest return" in said(metrics)
    assert resume[-1]["data"]["image/png"]
    assert_it_walks_out(said(act))


def said(outputs: list[Any]) -> str:
    return "".join(output["text"] for output in outputs if output["output_type"] == "stream")


TRAIN = "import millrace; run = millrace.train('CartPole-v1', steps=50_000_000, workers=2, eval_episodes=2)"
RESUME = """
import pathlib, numpy
(folder,) = pathlib.Path("runs").iterdir()
run = millrace.Run(folder)
before = int(run.metrics["time/iterations"][-1])
run.resume(steps=int(run.metrics["time/total_timesteps"][-1]) + 1_000)
updates = run.metrics["time/iterations"]
print(before, updates.tolist() == list(range(1, len(updates) + 1)), len(updates) > before)
"""


def test_interrupting_the_kernel_saves_the_run_and_it_can_be_resumed(tmp_path: Path) -> None:
    pytest.importorskip("ipykernel")
    manager, client = pytest.importorskip("jupyter_client.manager").start_new_kernel(
        kernel_name="python3", cwd=str(tmp_path)
    )
    heard: list[tuple[str, dict[str, Any]]] = []

    def hear(message: dict[str, Any]) -> None:
        heard.append((message["msg_type"], message["content"]))
        if message["msg_type"] == "update_display_data" and "-- interrupted" not in (kind for kind, _ in heard):
            heard.append(("-- interrupted", {}))
            manager.interrupt_kernel()

    try:
        reply = client.execute_interactive(TRAIN, output_hook=hear, timeout=120)
        assert (reply["content"]["status"], reply["content"]["ename"]) == ("error", "Interrupted")
        assert "env steps are saved" in "".join(next(content["traceback"] for kind, content in heard if kind == "error"))
        heard.clear()
        heard.append(("-- interrupted", {}))
        reply = client.execute_interactive(RESUME, output_hook=hear, timeout=120)
        assert reply["content"]["status"] == "ok", heard[-1]
        lines = "".join(content["text"] for kind, content in heard if kind == "stream").splitlines()
        before, nothing_repeated, went_on = lines[-1].split()
        assert (int(before) > 0, nothing_repeated, went_on) == (True, "True", "True")
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
