"""What the results of all queries say beside a run of one."""

import numpy as np

from spherloc import estimate
from spherloc.datasets import load_scene
from spherloc.experiments.results import DOUBTFUL, FAILED, LOCALIZED, QueryResult
from spherloc.geometry import pose, yaw_rotation
from spherloc.mapping.scenes.joint_outcome import TRIED
from spherloc_viz.app.said_together import SaidTogether, said_together
from spherloc_viz.app.text import ToldBeside, summary_html
from tests.tiny_scene import write_tiny_scene

HERE = pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
NEAR = (1.0, 0.1)
WHY = "Taken together with left/<2>.png, it should be 3.2 m from where it is found."


def row(status=LOCALIZED, remarks=(), cam_from_map=HERE):
    return QueryResult(0, "right/2.png", status, message="Found.", remarks=remarks, cam_from_map=cam_from_map)


def test_a_doubt_is_told_of_the_doubted_pose_only():
    doubted = row().doubted(WHY)
    assert said_together(doubted, HERE, NEAR) == SaidTogether(DOUBTFUL, WHY)
    beside = pose(yaw_rotation(np.radians(0.5)), HERE[:, 3])
    assert said_together(doubted, beside, NEAR) is not None, "another run of it, whose pose is hardly another"
    away = pose(np.eye(3), HERE[:, 3] + [0.0, 0.0, 0.2])
    turned = pose(yaw_rotation(np.radians(2.0)), HERE[:, 3])
    assert all(said_together(doubted, other, NEAR) is None for other in (away, turned, None))
    assert said_together(row(), HERE, NEAR) is None
    assert said_together(row(DOUBTFUL, ("Few of them agree.",)), HERE, NEAR) is None, "its run says that itself"


def test_a_query_that_another_one_helped_to_localize_is_told_as_such():
    said = f"{TRIED} that left/2.png gives, which was taken together with it, and localized."
    helped = row(remarks=("image.png: few matches.", said))
    away = pose(np.eye(3), np.zeros(3))
    assert said_together(helped, away, NEAR) == said_together(helped, None, NEAR) == SaidTogether(LOCALIZED, said)
    assert said_together(helped, HERE, NEAR) is not None, "its run by itself may find the pose, and not believe it"
    in_vain = row(FAILED, (f"{TRIED} that left/2.png gives, which was taken together with it, in vain.",), None)
    assert said_together(in_vain, None, NEAR) is None


def test_the_summary_of_a_run_tells_it_with_the_reason(tmp_path):
    trace = estimate(load_scene(write_tiny_scene(tmp_path)).problem(), "ransac-2p", {}, 0)
    html = summary_html(trace, ToldBeside(together=SaidTogether(DOUBTFUL, WHY)))
    assert "Success</b> by itself, <b" in html and ">doubtful</b> in the results of all queries · " in html
    assert "left/&lt;2&gt;.png, it should be 3.2 m" in html and "<2>" not in html
    assert "by itself" not in summary_html(trace)
