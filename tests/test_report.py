"""Pages of the report, 3D replays, model cards and folders to share."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lunar_rescue.scenes.postures import postures
from reproduce.analysis.runs import reference_runs
from reproduce.experiments.evaluate import evaluate
from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import train
from reproduce.report.cards import card, export, reference_run
from reproduce.report.notebook import fill_in, notebook_page
from reproduce.report.site import build_report
from reproduce.report.viewer import LARGEST, choose_clips, record, write_replay
from reproduce.storage.errors import UserError

PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNkYAAAAAYAAjCB0C8AAAAASUVORK5CYII="


def executed(path: Path) -> Path:
    """A notebook as papermill leaves one."""
    table = '<style scoped>td {}</style><table border="1" class="dataframe"><tr><td>7</td></tr></table>'
    outputs = [
        nbformat.v4.new_output("display_data", {"image/png": PIXEL}),
        nbformat.v4.new_output("display_data", {"text/html": table}),
    ]
    cells = [
        nbformat.v4.new_markdown_cell("# A *first* page\n\nWith $x_i^2$ and `$HOME`."),
        nbformat.v4.new_code_cell("secret = 6 * 7", outputs=outputs),
        nbformat.v4.new_markdown_cell("$$\\sum_i \\frac{a}{b}$$"),
    ]
    document = nbformat.v4.new_notebook(cells=cells)
    document.metadata["papermill"] = {"parameters": {"preset": "smoke"}, "end_time": "2026-01-01T00:00:00"}
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(document, path)
    return path


def test_a_notebook_becomes_a_page_with_code_folded_and_pictures_described(tmp_path: Path) -> None:
    page = notebook_page(executed(tmp_path / "01_try.ipynb"))
    assert page.title == "A *first* page" and "secret" not in page.text and "<math" not in page.text
    text = fill_in(page.text, page.pieces)
    assert '<details class="code"><summary>code</summary>' in text and "secret" in text and "open>" not in text
    assert re.search(r'<img alt="A first page"[^>]*src="data:image/png', text)
    assert "<table><tr>" in text and "<style scoped>" not in text
    assert text.count("<math") == 2 and "<mfrac>" in text and "`$HOME`" in text
    assert "`preset='smoke'`" in text and "2026-01-01" in text
    assert "notebooks/01_try.ipynb, cell 2" in text


@pytest.mark.process
def test_a_page_of_an_earlier_run_says_so(tmp_path: Path) -> None:
    page = executed(tmp_path / "notebooks" / "01_try.ipynb")
    assert "earlier run" not in notebook_page(page).text
    shutil.copyfile(page, page.with_name("01_try.failed.ipynb"))
    first = build_report(page.parent, tmp_path, replays=False)
    text = first.with_name("01_try.html").read_text()
    warning = text[text.index("From an earlier run") :]
    assert "notebooks/01_try.failed.ipynb" in warning and "finished 2026-01-01T00:00:00" in warning
    assert not first.with_name("01_try.failed.html").exists() and "01_try.failed.html" not in first.read_text()
    page.with_name("01_try.failed.ipynb").unlink()
    assert "earlier run" not in build_report(page.parent, tmp_path, replays=False).with_name("01_try.html").read_text()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with one trained and tested policy."""
    results = tmp_path_factory.mktemp("report") / "results"
    folder = results / "reference" / "ppo_lstm" / "seed0"
    method = METHODS["ppo_lstm"]
    config = replace(method.config("smoke"), steps=512, n_envs=2)
    train(method, config, 0, folder, "smoke", quiet=True, tensorboard=results / "scratch" / "tensorboard")
    evaluate(folder, 2, 2_020_000_000, quiet=True, json=folder / "evaluation.json")
    executed(results / "notebooks" / "01_try.ipynb")
    return results


@pytest.mark.process
def test_training_logs_for_tensorboard(results: Path) -> None:
    events = EventAccumulator(str(results / "scratch" / "tensorboard"))
    events.Reload()
    steps = [event.step for event in events.Scalars("training/success")]
    assert steps and steps[-1] == 512


@pytest.mark.process
def test_the_site_has_all_pages_and_keeps_the_old_one_on_failure(results: Path) -> None:
    first = build_report(results / "notebooks", results, replays=False)
    site = first.parent
    assert {"index.html", "01_try.html", "policy_ppo_lstm_0.html"} <= {path.name for path in site.glob("*.html")}
    assert "<mfrac>" in (site / "01_try.html").read_text()
    for page in site.rglob("*.html"):
        text = page.read_text()
        assert "@@" not in text, page.name
        assert not re.search(r'<(script|link|img)[^>]*(src|href)="https?:', text), page.name
    text = first.read_text()
    assert "No HRL-DCS policy of this version of the environment has been trained and tested yet." in text
    assert (
        text.count('<span class="verdict ') == 8
        and "at least 2 scenes" in text
        and "doi.org/10.3390/aerospace9060315" in text
    )
    assert re.search(r'<img class="chart" src="results.png" alt="Recurrent PPO: [^"]+ of 2 tests of 1 training."', text)
    assert (site / "results.png").stat().st_size > 5_000 and (site / "rescue.gif").is_file()
    bad = results / "notebooks" / "02_bad.ipynb"
    bad.write_text("{")
    with pytest.raises(Exception, match="JSON"):
        build_report(results / "notebooks", results, replays=False)
    bad.unlink()
    assert first.read_text() == text
    assert not list(results.glob(".report*"))


@pytest.mark.process
def test_a_replay_is_one_small_file_without_network(tmp_path: Path) -> None:
    recording = record("random", 3)
    steps = recording.row["steps"]
    assert len(recording.moments) == steps + 1
    assert recording.end.shape == (240, 320, 3) and np.ptp(recording.end) > 100, "a picture, not a plain colour"
    first, last = recording.moments[0], recording.moments[-1]
    assert any((first.links[link][0] != place).any() for link, (place, _) in last.links.items())
    write_replay(recording, tmp_path / "x.html")
    text = (tmp_path / "x.html").read_text()
    assert len(text) < LARGEST and "__VISER_EMBED_DATA__=" in text
    assert (
        re.search(r"<title>(lift|turn over), [a-z ]+: failed by [a-z ]+</title>", text) and "Viser</title>" not in text
    )
    assert "Balls that shine through" in text and "history.back()" in text
    assert not re.search(r'<(script|link|img)[^>]*(src|href)="https?:', text)


def test_clips_show_a_success_and_a_failure_of_each_method_and_every_posture(
    run_folder: Callable[..., Path], tmp_path: Path
) -> None:
    run_folder(tmp_path, "ppo_lstm", outcomes=[False, False, True, False], first_seed=2_020_000_005)
    clips = choose_clips(reference_runs(tmp_path))
    assert [(clip.label, clip.seed) for clip in clips[:2]] == [
        ("success: scene 2020000007", 2_020_000_007),
        ("failure: scene 2020000005", 2_020_000_005),
    ]
    named = {clip.file for clip in clips[2:]}
    assert named == {f"posture-{name}.html" for name in postures()}
    assert len({clip.file for clip in clips}) == len(clips)


@pytest.mark.process
def test_a_policy_is_shared_with_its_card(results: Path, tmp_path: Path) -> None:
    run = reference_run("ppo_lstm", results=results)
    text = card(run)
    assert text.startswith("---\nlicense: mit\n") and "environment version" in text and "## Limits" in text
    rate = 100 * (run.evaluation or {})["success_rate"]
    assert f"**{rate:.1f} %**" in text and "2 test scenes" in text
    out = export("ppo_lstm", tmp_path / "shared", results=results)
    assert {"README.md", "policy.safetensors", "policy.json", "config.json", "run.json"} <= {
        p.name for p in out.iterdir()
    }
    evaluate(out, 2, 2_020_000_000, quiet=True, json=tmp_path / "again.json")
    assert (tmp_path / "again.csv").read_text() == (out / "evaluation.csv").read_text()
    with pytest.raises(UserError, match="not empty"):
        export("ppo_lstm", out, results=results)
    for method, word in (("fun", "no trained reference run"), ("nonsense", "method")):
        with pytest.raises(UserError, match=word):
            export(method, tmp_path / "other", results=results)
    with pytest.raises(UserError, match="seed 9"):
        export("ppo_lstm", tmp_path / "other", seed=9, results=results)
    assert not (tmp_path / "other").exists()


@pytest.mark.process
def test_a_broken_policy_is_not_shared(results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "results"
    shutil.copytree(results / "reference", copy / "reference")
    (copy / "reference" / "ppo_lstm" / "seed0" / "policy.json").write_text("{")
    with pytest.raises(UserError, match=r"policy\.json"):
        export("ppo_lstm", tmp_path / "out", results=copy)
    assert not (tmp_path / "out").exists()
