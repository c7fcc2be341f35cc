"""What notebooks show of results, and the tables that pandas takes."""

import base64
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from fitting.experiments import experiment_files
from fitting.runtime.display import data_frames, notebook
from fitting.studies.fit import Fit
from support.experiments import write
from support.problems import posterior_of
from support.runs import NAMES, invented_fit

PICTURE = r'src="data:image/png;base64,([^"]+)"'


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    """Without a verdict, which would take the pipeline."""
    fit = invented_fit(tmp_path_factory.mktemp("fit"))
    vars(fit)["groups"] = []
    return fit


def tables(text: str) -> list[list[list[str]]]:
    """The cells of all tables of a page."""
    page = ElementTree.fromstring(re.sub(r"(<img [^>]*)>", r"\1/>", text))
    rows_of = [list(table.iter("tr")) for table in page.iter("table")]
    return [[[cell.text or "" for cell in row] for row in rows] for rows in rows_of]


def pictures(text: str) -> list[bytes]:
    return [base64.b64decode(data) for data in re.findall(PICTURE, text)]


def test_a_notebook_shows_the_clips_and_the_free_parameters_of_an_experiment(tmp_path):
    experiment = experiment_files.load_experiment(write(tmp_path, top='name = "a <b> & c"'))
    text = experiment._repr_html_()
    clips, free = tables(text)
    assert "a &lt;b&gt; &amp; c" in text and "Numbers are for an adult" in text
    files = ["uneven_walk.npz", "uneven_walk_base.npz", "uneven_walk.ply"]
    assert clips[1] == [*files, "1 s", "2 s"]
    assert [row[0] for row in free[1:]] == list(NAMES) and free[2][3] == "0.1 to 1.4"


def test_a_notebook_shows_a_fit_as_a_table_and_a_picture(fitted):
    text = fitted._repr_html_()
    (parameters,) = tables(text)
    assert [row[0] for row in parameters[1:]] == list(NAMES)
    (picture,) = pictures(text)
    assert picture.startswith(b"\x89PNG") and len(picture) > 10_000


def test_a_fit_is_a_table_of_pandas(fitted):
    table = fitted.table()
    assert list(table.index) == list(NAMES) and table.loc[NAMES[0], "kind"] == "smooth"
    np.testing.assert_array_equal(table["value"], fitted.solution.values)
    intervals = [row["interval"] for row in fitted.parameters]
    np.testing.assert_array_equal(table[["low95", "high95"]], intervals)


def test_a_posterior_is_shown_and_is_a_table():
    u = np.random.default_rng(0).normal(size=(200, 8, 2))
    posterior = posterior_of(NAMES, u, u)
    text = posterior._repr_html_()
    assert "Converged." in text and len(pictures(text)) == 1
    assert [row[0] for row in tables(text)[0][1:]] == list(NAMES)
    table = posterior.table()
    assert list(table.index) == list(NAMES)
    np.testing.assert_allclose(table["mean"], u.mean(axis=(0, 1)))


def test_tables_without_pandas_say_what_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(ImportError, match=r'this needs pandas: pip install "jaxik\[tables\]"'):
        data_frames.data_frame([{"name": "a"}], "name")


def test_anything_else_is_shown_as_its_text():
    assert notebook.html("a < b") == "<pre>&#x27;a &lt; b&#x27;</pre>"
