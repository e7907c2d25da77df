"""Pictures of episodes: what is drawn of them, the figure of rollouts and the videos."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

import fed_envs
from sb3_fedguide.benchmark import rollouts
from sb3_fedguide.benchmark.rollouts import Episode, Pictures, overlay, pictures, pose_steps, record
from sb3_fedguide.cli import video
from sb3_fedguide.cli.main import main

pytestmark = pytest.mark.usefixtures("coarse_figures")

SMALL = ["--rounds", "2", "--eval-episodes", "2", "--verbose", "0", "-params", "rollout_size:100", "n_envs_per_client:2",
         "bc_weight:0", "batch_size:50"]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs of two methods on Bandit2D and one on PointMaze, whose rollouts need no OpenGL."""
    folder = tmp_path_factory.mktemp("logs")
    for algo, env in (("local", "Bandit2D"), ("fedavg", "Bandit2D"), ("local", "PointMaze")):
        assert main(["train", "--algo", algo, "--env", env, "-f", str(folder), *SMALL]) == 0
    return folder


class Constant:
    """A policy that does not look."""

    def __init__(self, action):
        self.action = np.asarray(action, dtype=np.float32)

    def predict(self, obs, deterministic):
        assert deterministic
        return self.action, None


def episode(n: int, positions=()) -> Episode:
    return Episode(0, np.empty(0), np.zeros((n, 1)), np.array(positions), np.arange(n, dtype=float), 0.1)


def test_an_episode_is_played_without_noise_from_the_seeded_start():
    family = fed_envs.load_family("Reacher")
    one, again = (record(family, 3, Constant([0.5, -0.2]), seed=7) for _ in range(2))
    assert len(one) == family.max_episode_steps and one.observations.shape == (len(one) + 1, 10)
    np.testing.assert_array_equal(one.observations, again.observations)
    assert one.episode_return == one.rewards.sum() and not len(one.positions)
    hopper = record(fed_envs.load_family("Hopper"), 0, Constant(np.zeros(3)))
    assert len(hopper.positions) == len(hopper) + 1 and hopper.seconds == pytest.approx(0.008)


def test_poses_are_evenly_spaced_and_stay_on_the_ground_that_is_drawn(monkeypatch):
    assert pose_steps(episode(50), 3) == [0, 25, 50]
    assert pose_steps(episode(1), 5) == [0, 1]
    monkeypatch.setattr(rollouts, "GROUND", 3.4)
    walked = 10.0 + 0.25 * np.arange(101)  # a quarter of a metre a step, from 10 m
    assert pose_steps(episode(100, walked), 3) == [0, 7, 14]  # 3.5 m after 14 steps
    assert pose_steps(episode(100, np.full(101, 5.0)), 3) == [0, 50, 100]


def test_later_poses_are_stronger_and_the_rest_is_background():
    frames = np.full((3, 4, 4, 3), 100, dtype=np.uint8)
    for step in range(3):
        frames[step, 0, step] = 200
    frames[1, 3, 3] = 110  # no more than noise
    for background in (None, np.full((4, 4, 3), 100, dtype=np.uint8)):
        drawn = overlay(Pictures(frames, background, 1.0), faintest=0.2)
        assert drawn[0, :3, 0].tolist() == [120, 160, 200] and (drawn[1:] == 100).all()
    hidden = overlay(Pictures(frames[:1], np.zeros((4, 4, 3), dtype=np.uint8), 1.0))
    np.testing.assert_array_equal(hidden, frames[0])


def test_actions_are_played_again_for_pictures():
    family = fed_envs.load_family("Bandit2D")
    played = record(family, 1, Constant([0.3, 0.9]))
    found = pictures(family, played, [0, 1])
    env = family.make(1, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.array([0.3, 0.9], dtype=np.float32))
    assert found.frames.shape == (2, 240, 240, 3) and found.background is None and found.rate == 4.0
    np.testing.assert_array_equal(found.frames[1], env.render())


def test_rollouts_are_drawn_for_every_client_and_method(folder, tmp_path, capfd):
    out = tmp_path / "out"
    runs = [str(folder / algo / "Bandit2D_1") for algo in ("local", "fedavg")]
    assert main(["plot", *runs, "--figures", "rollouts", "-o", str(out)]) == 0
    maze = str(folder / "local" / "PointMaze_1")
    assert main(["plot", maze, "--figures", "rollouts", "--clients", "2", "5", "-o", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {"rollouts-Bandit2D.png", "rollouts-PointMaze.png"}
    assert main(["plot", runs[0], "--figures", "rollouts", "--clients", "9", "-o", str(out)]) == 2
    assert "Bandit2D has no client 9; there are 0, 1, 2, 3" in capfd.readouterr().err


def test_a_walking_body_is_not_drawn_without_a_display(folder, tmp_path, monkeypatch, capfd):
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert main(["train", "--algo", "local", "--env", "Reacher", "-f", str(tmp_path), *SMALL]) == 0
    capfd.readouterr()
    assert main(["plot", str(tmp_path / "local" / "Reacher_1"), "--figures", "rollouts", "-o", str(tmp_path / "out")]) == 2
    error = capfd.readouterr().err
    assert "rollouts: there is no display; set MUJOCO_GL=osmesa" in error and error.count("\n") == 1


def test_the_poses_of_a_body_are_photographed():
    """In a process of its own: MuJoCo chooses its OpenGL when it is imported."""
    import os
    import subprocess
    import sys

    script = """
import numpy as np, fed_envs
from sb3_fedguide.benchmark.rollouts import Episode, overlay, pictures
for name, size in (("Hopper", 3), ("Reacher", 2)):
    family = fed_envs.load_family(name)
    walks = np.array([0.0]) if name == "Hopper" else np.array([])
    episode = Episode(0, np.empty(0), np.full((9, size), 0.7, dtype=np.float32), walks, np.zeros(9), 0.008)
    found = pictures(family, episode, [0, 9], (64, 48))
    assert found.frames.shape == (2, 48, 64, 3) and found.background.shape == (48, 64, 3)
    poses = (np.abs(found.frames.astype(int) - found.background).max(axis=-1) > 14).sum(axis=(1, 2))
    assert (poses > 20).all(), poses
    assert overlay(found).std() > 1
walker = fed_envs.load_family("Walker2D").make(0, render_mode="rgb_array", width=64, height=48)
walker.reset(seed=0)
body = walker.unwrapped
there = body.data.qpos.copy()
there[0] += 20.0
body.set_state(there, body.data.qvel.copy())  # far from the start, the camera follows
drawn = walker.render().astype(int)
body.model.geom_rgba[body.model.geom_bodyid > 0, 3] = 0.0
assert (np.abs(drawn - walker.render()).max(axis=-1) > 14).sum() > 20
"""
    environment = {**os.environ, "MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    if done.returncode and "libosmesa6" in done.stderr:
        pytest.skip("no display-less OpenGL here (Debian: libosmesa6)")
    assert done.returncode == 0, done.stderr


def test_videos_are_large_and_say_whose_they_are(folder, tmp_path, monkeypatch, capfd):
    said = []
    caption = video.caption
    monkeypatch.setattr(video, "caption", lambda frame, *lines: said.append(lines) or caption(frame, *lines))
    run = str(folder / "fedavg" / "Bandit2D_1")
    assert main(["evaluate", run, "--episodes", "1", "--video", str(tmp_path / "video"), "--policy", "deployed"]) == 0
    written = sorted((tmp_path / "video").iterdir())
    assert [path.name for path in written] == [f"Bandit2D-client{k}-deployed.gif" for k in range(4)]
    with Image.open(written[0]) as picture:
        assert min(picture.size) >= video.SMALLEST and picture.n_frames == 2
    assert said[0][0].startswith("Bandit2D, client 0, fedavg: episode return ")
    assert said[0][1] == "step 0 of 1, return so far 0.00"
    assert capfd.readouterr().err.count("wrote ") == 4


def test_mp4_without_its_package_is_one_message(folder, tmp_path, monkeypatch, capfd):
    find = video.importlib.util.find_spec
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None if name == "moviepy" else find(name))
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", str(folder / "local" / "Bandit2D_1"), "--video", str(tmp_path / "v"), "--video-format", "mp4"])
    assert stop.value.code == 2 and "pip install 'sb3-fedguide[video]'" in capfd.readouterr().err


def test_gymnasium_writes_mp4(folder, tmp_path):
    pytest.importorskip("moviepy")
    run = str(folder / "local" / "Bandit2D_1")
    assert main(["evaluate", run, "--episodes", "1", "--video", str(tmp_path / "v"), "--video-format", "mp4"]) == 0
    names = sorted(path.name for path in (tmp_path / "v").iterdir())
    assert names == [f"Bandit2D-client{k}-deployed.mp4" for k in range(4)]
    assert (tmp_path / "v" / names[0]).read_bytes()[4:8] == b"ftyp"
