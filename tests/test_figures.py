"""The figures of a reproduction, looked at by their pixels."""

import numpy as np
import pytest
from test_pages import row

from shepherd_phys.controllers.claims import EXPERIMENTS

pytest.importorskip("matplotlib")

from shepherd_phys.scripts.figures import DPI, SIZE, STYLES, draw

FIGURE_2 = EXPERIMENTS["figure2"]


def pixels(png, tmp_path):
    import matplotlib.image

    path = tmp_path / "figure.png"
    path.write_bytes(png)
    return (matplotlib.image.imread(path)[..., :3] * 255).round().astype(int)


def has(picture, color):
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return bool((np.abs(picture - wanted).max(axis=2) <= 2).any())


def test_a_figure_shows_its_rows(tmp_path):
    rows = [row(name, k) for name in ("strombom", "elfiqi") for k in range(1, 6)]
    drawn = draw(FIGURE_2, rows)
    picture = pixels(drawn, tmp_path)
    assert picture.shape[:2] == (round(SIZE[1] * DPI), round(SIZE[0] * DPI))
    assert (picture[0, 0] == 255).all()  # a light ground
    shown = {name for name in ("strombom", "pierson", "elfiqi", "wild") if has(picture, STYLES[name][0])}
    assert shown == {"strombom", "elfiqi"}
    half = picture.shape[1] // 2
    other = pixels(draw(FIGURE_2, [*rows[:-1], row("elfiqi", 5, path=(150.0, 149.0, 151.0))]), tmp_path)
    changed = (picture != other).any(axis=2)
    assert changed[:, half:].any()
    assert not changed[:, :half].any()  # (a) shows what is delivered, and that is the same


def test_the_same_rows_give_the_same_bytes():
    rows = [row("strombom", k) for k in range(1, 6)]
    assert draw(FIGURE_2, rows) == draw(FIGURE_2, rows)
    assert b"Software" not in draw(FIGURE_2, rows)


def test_a_users_style_sheet_does_not_matter():
    import matplotlib

    rows = [row("strombom", k) for k in range(1, 6)]
    plain = draw(FIGURE_2, rows)
    with matplotlib.rc_context({"axes.facecolor": "black", "font.size": 30.0}):
        assert draw(FIGURE_2, rows) == plain


def test_equal_methods_do_not_hide_one_another(tmp_path):
    picture = pixels(draw(FIGURE_2, [row(name, k) for name in STYLES for k in range(1, 6)]), tmp_path)
    panel = picture[: int(0.7 * len(picture)), : picture.shape[1] // 2]  # without the legend
    assert all(has(panel, color) for color, _ in STYLES.values())


def test_styles_are_distinct():
    assert len(set(STYLES.values())) == len(STYLES) - 3  # the three as published are the tuned ones', hollow
    assert len({marker for _, marker in STYLES.values()}) == len(STYLES) - 3


def test_controllers_of_ones_own_are_drawn(tmp_path):
    rows = [row(name, k) for name in ("mine:A", "mine:B") for k in (1, 2)]
    assert has(pixels(draw(FIGURE_2, rows), tmp_path), "#000000")


def test_a_single_point_is_drawn():
    assert draw(FIGURE_2, [row("strombom", 1)]).startswith(b"\x89PNG")
