"""Test the report of ambiguities.

An ambiguity is a pair of changes, such as a brighter light and darker materials, that together leave the photos nearly the same.
"""

import json

import pytest
import torch

from benchmarks.stability.training import trainer
from refgs.report.page import write_report
from refgs.train.keep.ambiguity import TRADES, _pictures, ambiguities


@pytest.fixture(scope="module")
def ball(ball_capture, tmp_path_factory):
    made = trainer(ball_capture, total=150, folder=tmp_path_factory.mktemp("run"))
    made.run()
    return made.state


def test_what_is_left_is_what_both_changes_leave(ball):
    """Check the reported value `left`: how much two changes that nearly cancel still alter the pictures.

    It must agree to 30 % with a direct measurement. The measurement makes both changes together, reduced to a tenth, and renders the
    result. It multiplies the difference of the pictures by ten.
    """
    found = ambiguities(ball)
    now = ball.surfels(), ball.environment().radiance
    views = range(0, len(ball.views), 4)
    with torch.no_grad():
        before = torch.stack([*_pictures(ball, now, views)])
        for name, trade in TRADES.items():
            facts = found[name]
            assert 0 < facts["left"] <= facts["alone"]
            both = trade.made_up(trade.change(now, 0.1 * trade.size), 0.1 * facts["answer"])
            change = (torch.stack([*_pictures(ball, both, views)]) - before).square().mean().sqrt() / 0.1
            assert float(change) == pytest.approx(facts["left"], rel=0.3), name


def test_a_metals_light_has_no_scale_of_its_own(ball):
    found = ambiguities(ball)
    assert found["light_scale"]["left"] < 0.2 * found["light_scale"]["alone"]
    assert found["light_scale"]["answer"] == pytest.approx(-0.25, abs=0.05)
    assert "what" in found["light_scale"] and "what" not in found["metal"]


def test_no_light_no_trades(ball_capture, tmp_path):
    assert ambiguities(trainer(ball_capture, "shading=sh", folder=tmp_path).state) == {}


def test_the_report_says_it(ball):
    (ball.folder / "metrics.json").write_text(json.dumps({"ambiguities": ambiguities(ball)}))
    write_report([ball.folder], ball.folder / "report.html")
    text = (ball.folder / "report.html").read_text()
    assert "What the photos do not tell" in text
    assert "Light brighter by a quarter: base colour can make up for it" in text
    (ball.folder / "metrics.json").write_text("{}")
    write_report([ball.folder], ball.folder / "report.html")
    assert "What the photos do not tell" not in (ball.folder / "report.html").read_text()
