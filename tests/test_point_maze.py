"""PointMaze: gymnasium-robotics' own environment for a nominal client, the clients' parameters, maps and behaviour."""

from __future__ import annotations

import os
import pickle
import sys

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium_robotics.envs.maze import maps
from gymnasium_robotics.envs.maze.maze_v4 import Maze
from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv as RoboticsPointMaze

import fed_envs
from fed_envs import FederatedVecEnv
from fed_envs.generation import OWN_SEEDS, generate_family
from fed_envs.mazes import FREE, MAZES, WALL, cell_center, distances, free_cells, maze_rows
from fed_envs.metadata import Family, parse_family
from fed_envs.point_maze import PointMazeEnv
from tests.conftest import ends_first
from tests.rendering import check_pictures

FAMILIES = ("PointMaze", "PointMazeHard")
CLIENTS = [(name, k) for name in FAMILIES for k in range(8)]
ROBOTICS_MAPS = {"Open": maps.OPEN, "UMaze": maps.U_MAZE, "Medium": maps.MEDIUM_MAZE, "Large": maps.LARGE_MAZE}


def family(*clients: dict, steps: int = 300) -> Family:
    content = {
        "schema_version": 1,
        "family": "Mine",
        "world": "point_maze",
        "backbone": "PointMaze-v3",
        "max_episode_steps": steps,
        "clients": [{"client": k, **client} for k, client in enumerate(clients)],
    }
    return parse_family(content, "mine")


def flat(observation: dict) -> np.ndarray:
    np.testing.assert_array_equal(observation["achieved_goal"], observation["observation"][:2])
    return np.concatenate([observation["observation"], observation["desired_goal"]])


@pytest.mark.parametrize("name", MAZES)
def test_named_maps_are_gymnasium_robotics(name):
    theirs = tuple("".join(WALL if cell == 1 else FREE for cell in row) for row in ROBOTICS_MAPS[name])
    assert MAZES[name] == theirs == maze_rows(name)
    maze = Maze(ROBOTICS_MAPS[name], 1.0, 0.4)
    for cell in free_cells(theirs):
        np.testing.assert_array_equal(cell_center(theirs, cell), maze.cell_rowcol_to_xy(np.array(cell)))


@pytest.mark.parametrize(
    ("maze", "goals", "starts"),
    [
        ("Open", [(1, 1), (3, 5)], []),
        ("UMaze", [(3, 1)], [(1, 1), (2, 3)]),
        ("Medium", [(6, 6)], []),
        ("Large", [(7, 1), (7, 10)], [(1, 1), (5, 7)]),
    ],
)
def test_nominal_client_is_gymnasium_robotics(maze, goals, starts):
    """Starts, goals, states, rewards and success to the last bit, with walls hit and velocities beyond the clipping."""
    labelled = [list(row) for row in ROBOTICS_MAPS[maze]]
    for cells, label in ((goals, maps.GOAL), (starts, maps.RESET)):
        for i, j in cells:
            labelled[i][j] = label
    theirs = RoboticsPointMaze(maze_map=labelled, reward_type="dense")
    os.unlink(theirs.tmp_xml_file_path)
    fields = {"start_cells": starts} if starts else {}
    ours = family({"maze": maze, "goal_cells": goals, **fields}).make(0).unwrapped
    assert ours.action_space == theirs.action_space
    assert ours.metadata["render_fps"] == theirs.point_env.metadata["render_fps"]
    rng = np.random.default_rng(0)
    contacts = fast = successes = 0
    for episode in range(6):
        observation, info = ours.reset(seed=episode if episode < 4 else None)
        expected, expected_info = theirs.reset(seed=episode if episode < 4 else None)
        np.testing.assert_array_equal(observation, flat(expected))
        assert info == {**expected_info, "is_success": False}
        reached = False
        if episode == 5:  # next to the goal, to see successes
            for env in (ours, theirs.point_env):
                env.set_state(ours.goal + 0.3, np.zeros(2))
        for step in range(300):
            if step % 30 == 0:
                push = rng.uniform(-1.5, 1.5, 2)
            action = (push + rng.normal(0, 0.3, 2)).astype(np.float32)
            observation, reward, terminated, truncated, info = ours.step(action)
            expected = theirs.step(action)
            np.testing.assert_array_equal(observation, flat(expected[0]))
            reached |= expected[4]["success"]
            assert (reward, terminated, truncated, info) == (*expected[1:4], {**expected[4], "is_success": reached})
            contacts += ours.data.ncon > 0
            fast += bool(np.abs(observation[2:4]).max() > 5.0)
            successes += info["success"]
    assert contacts > 50 and fast and successes


@pytest.mark.parametrize(("name", "client"), CLIENTS)
def test_built_environment_has_its_clients_parameters(name, client):
    parameters = fed_envs.load_family(name).clients[client]
    env = gymnasium.make(f"fed_envs/{name}-v0", client=client).unwrapped
    np.testing.assert_allclose(env.model.actuator_gear[:, 0], 100.0 * parameters.gear_scale, rtol=1e-12)
    np.testing.assert_allclose(env.model.dof_damping, parameters.damping_scale, rtol=1e-12)
    rows = maze_rows(parameters.maze)
    assert env.model.ngeom == 2 + sum(row.count(WALL) for row in rows)  # the ground and the ball besides
    seen: dict[str, set] = {"goal": set(), "start": set()}
    env.reset(seed=0)
    for _ in range(200):
        observation, _ = env.reset()
        assert (observation[2:4] == 0).all()
        for kind, point in (("goal", observation[4:]), ("start", observation[:2])):
            cell = (int(len(rows) / 2 - point[1]), int(point[0] + len(rows[0]) / 2))
            assert np.abs(point - cell_center(rows, cell)).max() <= 0.25
            seen[kind].add(cell)
        np.testing.assert_array_equal(env.data.site("target").xpos[:2], observation[4:])
    assert seen == {"goal": set(parameters.goal_cells), "start": set(parameters.starts())}
    # Dynamics from Newton's law (in free space: the first step after a reset), reward from its definition.
    action = np.array([0.3, -0.8], dtype=np.float32)
    before = env.data.qpos.copy()
    observation, reward, terminated, _, info = env.step(action)
    mass, dt = env.model.body_mass[1], 0.01
    # Euler with implicit damping
    velocity = dt * 100.0 * parameters.gear_scale * action.astype(float) / (mass + dt * parameters.damping_scale)
    np.testing.assert_allclose(observation[2:4], velocity, rtol=1e-10)
    np.testing.assert_allclose(observation[:2], before + dt * velocity, rtol=1e-10)
    distance = np.linalg.norm(observation[:2] - observation[4:])
    np.testing.assert_allclose(reward, parameters.reward_scale * np.exp(-distance), rtol=1e-12)
    assert not terminated and info == {"success": distance <= 0.45, "is_success": distance <= 0.45}


def test_starts_in_the_goals_cell_are_redrawn():
    cells = [[1, 1], [1, 2]]
    env = family({"maze": "Open", "goal_cells": cells, "start_cells": cells}).make(0)
    env.reset(seed=0)
    starts = np.array([env.reset()[0] for _ in range(100)])
    assert (np.sign(starts[:, 0] + 1.5) == -np.sign(starts[:, 4] + 1.5)).all()


def test_own_rows_are_a_maze():
    rows = ["######", "#.#..#", "#....#", "######"]
    env = family({"maze": rows, "goal_cells": [[1, 1]], "start_cells": [[1, 3]]}).make(0)
    walls = [mujoco.mj_id2name(env.unwrapped.model, mujoco.mjtObj.mjOBJ_GEOM, i) for i in range(env.unwrapped.model.ngeom)]
    assert "block_1_2" in walls and "block_2_2" not in walls
    observation, _ = env.reset(seed=0)
    for _ in range(300):  # straight to the left, into the wall
        observation, *_ = env.step(np.array([-1.0, 0.5], dtype=np.float32))
    assert 0.0 < observation[0] < 0.12


@pytest.mark.parametrize("name", FAMILIES)
def test_vectorised_steps_keep_goals_of_copies_and_resets(name):
    """Goals belong to episodes: after resets, pickling, and while environments wait."""
    short = parse_family(fed_envs.load_family(name).to_dict() | {"max_episode_steps": 20, "family": "Short"}, "short")
    venv = FederatedVecEnv(short, 2)
    venv.seed(0)
    goals = venv.reset()[:, 4:]
    rng = np.random.default_rng(0)
    for number in range(1, 70):
        if number == 25:
            venv.active[3] = False
            venv = pickle.loads(pickle.dumps(venv))
        actions = rng.uniform(-1, 1, (16, 2)).astype(np.float32)
        observations, rewards, dones, infos = venv.step(actions)
        reset = np.zeros(16, dtype=bool) if number % 20 else venv.active
        np.testing.assert_array_equal(dones, reset)
        np.testing.assert_array_equal(observations[~reset, 4:], goals[~reset])
        for row in np.flatnonzero(reset):
            last = infos[row]["terminal_observation"]
            np.testing.assert_array_equal(last[4:], goals[row])
            scale = short.clients[row // 2].reward_scale
            np.testing.assert_allclose(rewards[row], scale * np.exp(-np.linalg.norm(last[:2] - last[4:])), rtol=1e-6)
            assert (observations[row, 4:] != goals[row]).all()
        goals = observations[:, 4:]
    assert len(np.unique(goals, axis=0)) == 16


def test_successes_belong_to_the_step_and_to_the_episode():
    """Through the goal and past it: ``is_success`` stays until the reset, also while waiting and after pickling."""
    venv = FederatedVecEnv(family({"maze": "Open", "goal_cells": [[2, 3]], "start_cells": [[2, 1]]}, steps=150), 2)
    venv.seed(0)
    venv.reset()
    actions = np.array([[1.0, 0.0], [0.0, 0.0]], dtype=np.float32)
    seen = []
    for step in range(149):
        if step == 100:
            venv = pickle.loads(pickle.dumps(venv))
            venv.active[0] = False
        if step == 110:
            venv.active[0] = True
        observations, _, _, infos = venv.step(actions)
        if 100 <= step < 110:
            assert infos[0] == {}
        else:
            near = np.linalg.norm(observations[0, :2] - observations[0, 4:]) <= 0.45
            seen.append(infos[0]["success"])
            assert seen[-1] == near and infos[0]["is_success"] == any(seen)
        assert infos[1] == {"success": False, "is_success": False}
    assert any(seen) and not seen[-1]
    ended = FederatedVecEnv(venv.family, 1)
    ended.seed(0)
    ended.reset()
    for _ in range(150):
        *_, infos = ended.step(actions[:1])
    assert infos[0]["episode"]["l"] == 150 and infos[0]["is_success"] and not infos[0]["success"]
    assert not ended.step(actions[:1])[3][0]["is_success"]


@pytest.mark.parametrize(("name", "client"), ends_first(CLIENTS))
def test_scripted_policy_reaches_the_goals(name, client):
    own = fed_envs.load_family(name)
    policy = PointMazeEnv.scripted_policy(own, client)
    venv = FederatedVecEnv(own, 10, clients=[client])
    venv.seed(1)
    observations, rng = venv.reset(), np.random.default_rng(1)
    actions = []
    for _ in range(299):
        actions.append(policy(observations, rng))
        observations, *_ = venv.step(actions[-1])
    executed = np.array(actions)
    assert executed.dtype == np.float32 and np.abs(executed).max() < 1.0
    assert (np.linalg.norm(observations[:, :2] - observations[:, 4:], axis=1) < 0.45).all()
    again = policy(observations, np.random.default_rng(2))
    np.testing.assert_array_equal(again, policy(observations, np.random.default_rng(2)))
    assert (again != policy(observations, np.random.default_rng(3))).any()


def test_ways_are_shortest():
    rows = maze_rows("UMaze")
    assert distances(rows, (1, 1)) == {(1, 1): 0, (1, 2): 1, (1, 3): 2, (2, 3): 3, (3, 3): 4, (3, 2): 5, (3, 1): 6}


@pytest.mark.parametrize("name", FAMILIES)
def test_shipped_families_come_from_the_generator(name):
    shipped = fed_envs.load_family(name)
    assert generate_family(name, 8, OWN_SEEDS[name], name=name).content_hash == shipped.content_hash
    assert len({(client.maze, client.goal_cells) for client in shipped.clients}) == 8
    for client in generate_family("PointMazeHard", 40, seed=3).clients:
        steps = distances(maze_rows(client.maze), client.goal_cells[0])
        assert all(2 <= steps[cell] <= 6 for cell in client.start_cells)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"maze": "Medum"}, "maze: must be one of Open, UMaze, Medium, Large"),
        ({"maze": 3}, "maze: must be one of .*got 3"),
        ({"maze": []}, "maze: rows consist of"),
        ({"maze": ["###", "#x#", "###"]}, "maze: rows consist of"),
        ({"maze": ["####", "#..#", "###"]}, r"maze: all rows must have the same length; they have \[4, 4, 3\]"),
        ({"maze": ["####", "#...", "####"]}, "maze: the map's border must be walls"),
        ({"maze": ["###", "#.#", "###"]}, "maze: a map needs at least two free cells"),
        ({"goal_cells": []}, "goal_cells: .*at least 1"),
        ({"goal_cells": [[0, 0]]}, r"goal_cells: not free in this maze: \(0, 0\)"),
        ({"goal_cells": [[1, 1], [1, 1]]}, "goal_cells: each cell once"),
        ({"goal_cells": [[1.5, 1]]}, "goal_cells"),
        ({"start_cells": [[9, 9]]}, r"start_cells: not free in this maze: \(9, 9\)"),
        ({"goal_cells": [[1, 2]], "start_cells": [[1, 2]]}, "start_cells: episodes with the goal .* need a start elsewhere"),
        ({"maze": ["#####", "#.#.#", "#####"], "goal_cells": [[1, 1]]}, r"start_cells: no path leads from \(1, 3\)"),
        ({"gear_scale": 0.0}, "gear_scale: .*greater than 0"),
        ({"mass_scale": 1.0}, "mass_scale: is not a known field"),
    ],
)
def test_broken_clients_are_refused(fields, message):
    with pytest.raises(ValueError, match=f"client 0 .*: {message}"):
        family({"maze": "Open", "goal_cells": [[1, 1]], **fields})


@pytest.mark.parametrize("name", ["PointMazeHard", pytest.param("PointMaze", marks=pytest.mark.slow)])
def test_rgb_arrays_without_a_display(name):
    check_pictures(name)


def test_picture_of_trajectories(tmp_path, monkeypatch, capsys):
    """The script on two saved federations of untrained clients; the deployed policies of one are those of the other."""
    import importlib.util
    import json
    from pathlib import Path

    from sb3_fedguide.cli.run_folder import PARAMETERS, write_deployed, write_yaml
    from sb3_fedguide.settings.config import resolve

    path = Path(__file__).resolve().parent.parent / "benchmarks" / "point_maze_trajectories.py"
    spec = importlib.util.spec_from_file_location("point_maze_trajectories", path)
    script = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, script)
    spec.loader.exec_module(script)
    own = family({"maze": "UMaze", "goal_cells": [[1, 1]]}, {"maze": "Open", "goal_cells": [[2, 2]]}, steps=40)
    config = resolve("local", own, overrides={"rollout_size": 40, "batch_size": 20, "bc_weight": 0.0})
    models = [config.make(FederatedVecEnv(own, config.values["n_envs_per_client"]), seed=seed) for seed in (0, 1)]
    folders = [tmp_path / "first", tmp_path / "second"]
    for folder, model in zip(folders, models, strict=True):
        folder.mkdir()
        model.export_parameters(folder / PARAMETERS)
        write_yaml(folder / "config.yml", config.values)
        own.dump(folder / "metadata.json")
        (folder / "summary.json").write_text(json.dumps({"algo": "local", "env": own.name, "rounds_done": 1}))
    write_deployed(folders[1], {name: tensor.numpy() for name, tensor in models[0].policy.state_dict().items()})

    first, second = (script.roll_out(*script.read_run(folder), n_episodes=3, seed=5) for folder in folders)
    assert first.observations.shape == (2, 3, 41, 6) and np.isfinite(first.observations).all()
    np.testing.assert_array_equal(first.observations, second.observations)
    assert (first.observations[..., 0, 4:] == first.observations[..., -1, 4:]).all()  # not the next episode's
    distance = np.linalg.norm(first.observations[:, :, 1:, :2] - first.observations[:, :, 1:, 4:], axis=-1)
    np.testing.assert_allclose(first.returns, np.exp(-distance).sum(axis=-1), rtol=1e-5)
    assert (first.successes == (distance[..., -1] <= 0.45)).all()

    script.main([*map(str, folders), "-o", str(tmp_path / "mazes.png"), "--episodes", "2"])
    assert (tmp_path / "mazes.png").read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("local: average") == 2
    fed_envs.load_family("Reacher").dump(folders[1] / "metadata.json")
    with pytest.raises(ValueError, match="is a run on Reacher; only PointMaze families"):
        script.read_run(folders[1])
    with pytest.raises(ValueError, match=r"has no summary\.json"):
        script.read_run(tmp_path)
