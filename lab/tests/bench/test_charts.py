"""Which line looks how."""

from pathlib import Path

import numpy as np
import pytest

from engram_lab.charts import Line, Panel, draw_curves


def legend_of(
    monkeypatch: pytest.MonkeyPatch, labels: list[str], looks: dict[str, tuple[str, str]]
) -> dict[str, tuple[str, str]]:
    from matplotlib import pyplot

    shown: dict[str, tuple[str, str]] = {}

    def keep(figure, path: Path) -> None:
        [legend] = figure.legends
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
            shown[text.get_text()] = (handle.get_color(), handle.get_linestyle())
        pyplot.close(figure)

    monkeypatch.setattr("engram_lab.charts.save", keep)
    line = np.arange(2.0)
    panel = Panel("", "", "", [Line(label, line, line) for label in labels])
    draw_curves([panel], Path("unused.png"), "", looks)
    return shown


def test_labels_without_a_look_take_what_the_picture_has_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = {"a": ("C1", "-"), "b": ("C0", "-"), "absent": ("C2", "-")}
    shown = legend_of(monkeypatch, ["new", "b", "a", "newer"], looks)
    assert shown == {
        "a": ("C1", "-"),
        "b": ("C0", "-"),
        "new": ("C2", "-"),
        "newer": ("C3", "-"),
    }


def test_many_labels_get_other_line_styles_and_begin_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown = legend_of(monkeypatch, [f"{k:02d}" for k in range(40)], {})
    assert shown["10"] == ("black", "-")
    assert shown["11"] == ("C0", "--")
    assert shown["33"] == ("C0", "-")


def test_a_logarithmic_panel_without_anything_above_its_least_value_is_drawn(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    zeros = Line("nothing missed", np.arange(3.0), np.zeros(3))
    some = Line("something missed", np.arange(3.0), np.array([100.0, 1.0, 0.0]))
    for lines in ([zeros], [zeros, some]):
        draw_curves([Panel("", "", "", lines, least_y=0.01)], tmp_path / "a.png", "")
    draw_curves([Panel("", "", "", [zeros])], tmp_path / "a.png", "")
    assert [str(one.message) for one in recwarn.list] == []
