"""Pictures of episodes: what is drawn of them, the figure of rollouts and the videos."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import fed_envs
from sb3_fedguide.benchmark import bandit2d, rollouts
from sb3_fedguide.benchmark.figures.rollouts import _title
from sb3_fedguide.benchmark.rollouts import Episode, Poses, overlay, pictures, pose_steps, record
from sb3_fedguide.cli import evaluate, video
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
    return Episode(0, np.empty(0), np.zeros((n, 1)), np.array(positions), np.arange(n, dtype=float), 0.1, 10.0, 0)


def test_an_episode_is_played_without_noise_from_the_seeded_start():
    family = fed_envs.load_family("Reacher")
    one, again = (record(family, 3, Constant([0.5, -0.2]), seed=7) for _ in range(2))
    assert len(one) == family.max_episode_steps and one.observations.shape == (len(one) + 1, 10)
    np.testing.assert_array_equal(one.observations, again.observations)
    assert one.episode_return == one.rewards.sum() and not len(one.positions) and (one.rate, one.seed) == (50.0, 7)
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
        drawn = overlay(Poses(frames, background), faintest=0.2)
        assert drawn[0, :3, 0].tolist() == [120, 160, 200] and (drawn[1:] == 100).all()
    hidden = overlay(Poses(frames[:1], np.zeros((4, 4, 3), dtype=np.uint8)))
    np.testing.assert_array_equal(hidden, frames[0])


def test_titles_have_the_digits_of_tables():
    titles = [_title(replace(episode(1), rewards=np.array([value]))) for value in (0.5, -12.34, 812.3)]
    assert titles == ["client 0: 0.500", "client 0: -12.3", "client 0: 812"]


def test_actions_are_played_again_for_pictures():
    family = fed_envs.load_family("Bandit2D")
    played = record(family, 1, Constant([0.3, 0.9]))
    found = list(pictures(family, played, [0, 1]))
    env = family.make(1, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.array([0.3, 0.9], dtype=np.float32))
    assert [frame.shape for frame in found] == [(240, 240, 3)] * 2 and played.rate == 4.0
    np.testing.assert_array_equal(found[1], env.render())


def test_rollouts_are_drawn_for_every_client_and_method(folder, tmp_path, monkeypatch, capfd):
    out = tmp_path / "out"
    runs = [str(folder / algo / "Bandit2D_1") for algo in ("local", "fedavg")]
    densities = []
    monkeypatch.setattr(bandit2d, "policies", lambda model, found=bandit2d.policies: densities.append(model) or found(model))
    assert main(["plot", *runs, "--figures", "rollouts", "-o", str(out)]) == 0
    assert len(densities) == len(runs)  # not once per client
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
from sb3_fedguide.benchmark.rollouts import Episode, overlay, poses
for name, size in (("Hopper", 3), ("Reacher", 2)):
    family = fed_envs.load_family(name)
    walks = np.array([0.0]) if name == "Hopper" else np.array([])
    episode = Episode(0, np.empty(0), np.full((9, size), 0.7, dtype=np.float32), walks, np.zeros(9), 0.008, 125.0, 0)
    found = poses(family, episode, [0, 9], (64, 48))
    assert found.frames.shape == (2, 48, 64, 3) and found.background.shape == (48, 64, 3)
    moving = (np.abs(found.frames.astype(int) - found.background).max(axis=-1) > 14).sum(axis=(1, 2))
    assert (moving > 20).all(), moving
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
up = {"lookat": np.array([0.0, 0.0, 100.0]), "elevation": 90.0}
sky = fed_envs.load_family("Walker2D").make(0, render_mode="rgb_array", width=64, height=48, camera=up)
sky.reset(seed=0)
seen = sky.render()
assert seen.shape == (48, 64, 3) and sky.unwrapped._renderer.camera_id == -1
sky.unwrapped.model.geom_rgba[:, 3] = 0.0
assert (seen == sky.render()).all()  # no body, no floor: the camera that was asked for
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
    assert said[0][1] == "step 0 of 1, return so far 0.000"
    assert capfd.readouterr().err.count("wrote ") == 4


def test_mp4_without_its_package_is_one_message(folder, tmp_path, monkeypatch, capfd):
    find = video.importlib.util.find_spec
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None if name == "moviepy" else find(name))
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", str(folder / "local" / "Bandit2D_1"), "--video", str(tmp_path / "v"), "--video-format", "mp4"])
    assert stop.value.code == 2 and "pip install 'sb3-fedguide[video]'" in capfd.readouterr().err


def test_moviepy_writes_mp4(folder, tmp_path):
    pytest.importorskip("moviepy")
    run = str(folder / "local" / "Bandit2D_1")
    assert main(["evaluate", run, "--episodes", "1", "--video", str(tmp_path / "v"), "--video-format", "mp4"]) == 0
    names = sorted(path.name for path in (tmp_path / "v").iterdir())
    assert names == [f"Bandit2D-client{k}-deployed.mp4" for k in range(4)]
    assert (tmp_path / "v" / names[0]).read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(("length", "rate"), [(500, 80.0), (1000, 125.0), (1000, 20.0), (998, 50.0), (300, 10.0), (7, 125.0)])
def test_frames_of_a_gif_are_few_and_play_at_the_environments_speed(length, rate, tmp_path):
    steps = video.frame_steps(length, rate, video.MAX_FRAMES)
    assert steps[0] == 0 and steps[-1] == length and len(steps) <= video.MAX_FRAMES
    frames = (Image.fromarray(np.full((4, 4, 3), 40 * (step % 7), dtype=np.uint8)) for step in range(len(steps)))
    video._write_gif(tmp_path / "v.gif", frames, [step / rate for step in steps])
    with Image.open(tmp_path / "v.gif") as picture:
        delays = [picture.seek(frame) or picture.info["duration"] for frame in range(picture.n_frames)]
    assert len(delays) == len(steps) and delays[-1] == 1000
    assert sum(delays[:-1]) == pytest.approx(1000 * length / rate, abs=5)
    assert min(delays) >= 20  # browsers take what is shorter for 100 ms


def test_a_video_as_mp4_has_all_frames_that_can_be_seen():
    assert len(video.frame_steps(1000, 125.0, None)) == 251 and len(video.frame_steps(1000, 20.0, None)) == 1001
    assert video.frame_steps(1, 125.0, None) == [0, 1]


@pytest.mark.parametrize("suffix", video.FORMATS)
def test_frames_are_written_as_they_are_drawn(suffix, tmp_path, monkeypatch):
    if suffix == "mp4":
        pytest.importorskip("moviepy")
    alive: list[weakref.ref] = []
    made = []

    def drawn(family, episode, steps):
        for step in steps:
            frame = np.full((16, 16, 3), 5 * step, dtype=np.uint8)
            alive.append(weakref.ref(frame))
            yield frame
            assert sum(reference() is not None for reference in alive) <= 2

    class Model:
        client_ids = (2,)

        def client(self, k):
            return Constant([0.5, -0.2])

    monkeypatch.setattr(video, "pictures", drawn)
    monkeypatch.setattr(video, "SMALLEST", 64)
    make = fed_envs.Family.make
    monkeypatch.setattr(fed_envs.Family, "make", lambda *args, **kwargs: made.append(args) or make(*args, **kwargs))
    family = fed_envs.load_family("Reacher")
    (path,) = video.write_videos(tmp_path, "deployed", "local", family, Model(), 0, suffix)
    assert len(alive) == 26 and len(made) == 1  # its episode, 50 steps at 50 a second; the frame rate needs none of its own
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    if suffix == "mp4":
        from imageio_ffmpeg import count_frames_and_secs  # comes with moviepy

        frames, seconds = count_frames_and_secs(path)
        assert frames == 26 and seconds == pytest.approx(26 / 25, abs=0.02)


def test_the_help_says_which_episode_a_video_shows():
    text = " ".join(evaluate._parser("fedguide evaluate").format_help().split())
    assert "one deterministic episode of each client" in text and "first episode" not in text
    with pytest.raises(TypeError, match="seed"):
        video.write_videos("videos", "deployed", "local", None, None)  # type: ignore[call-arg]
