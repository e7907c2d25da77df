"""Videos of clients' episodes: GIF by Pillow, or MP4 by Gymnasium's own writer."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_fedguide.benchmark.rollouts import pictures, record

if TYPE_CHECKING:
    from PIL.Image import Image

    from fed_envs import Family
    from sb3_fedguide.common.federation import Federation

FORMATS = ("gif", "mp4")
#: Width and height of a frame are at least so many pixels.
SMALLEST = 480
#: Frames per second, at most. An environment that is faster leaves frames out, and keeps its speed.
FASTEST = 34
#: Frames of a GIF: more would make it unwieldy.
MAX_FRAMES = 200
_COLORS = 64


def check_format(suffix: str) -> None:
    """:raises ValueError: where what writes it is not installed"""
    if suffix == "mp4" and importlib.util.find_spec("moviepy") is None:
        raise ValueError("--video-format mp4 needs moviepy: pip install 'sb3-fedguide[video]', or take gif")


def write_videos(
    folder: Path, policy: str, algo: str, family: Family, model: Federation, suffix: str = "gif", seed: int = 0
) -> list[Path]:
    """One episode of each client with the model's current policies, client and return written into the picture.

    :param policy: which of the run's policies these are; part of the files' names
    :return: the files
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for client in model.client_ids:
        path = folder / f"{family.name}-client{client}-{policy}.{suffix}"
        episode = record(family, client, model.client(client), seed)
        steps = _steps(len(episode), family, MAX_FRAMES if suffix == "gif" else None)
        found = pictures(family, episode, steps, seed=seed)
        heading = f"{family.name}, client {client}, {algo}: episode return {episode.episode_return:.2f}"
        lines = [f"step {step} of {len(episode)}, return so far {episode.rewards[:step].sum():.2f}" for step in steps]
        captioned = [caption(frame, heading, line) for frame, line in zip(found.frames, lines, strict=True)]
        (_write_gif if suffix == "gif" else _write_mp4)(
            path, captioned, found.rate / (steps[1] - steps[0] if len(steps) > 1 else 1)
        )
        written.append(path)
    return written


def _steps(length: int, family: Family, most: int | None) -> list[int]:
    """Steps after which there is a frame: evenly spaced, and the last.

    :param most: of them; ``None`` for no limit
    """
    env = family.make(family.clients[0].client)
    rate = float(env.metadata.get("render_fps", 30))
    env.close()
    every = max(math.ceil(rate / FASTEST), math.ceil(length / most) if most else 1)
    return sorted({*range(0, length + 1, every), length})


def caption(frame: np.ndarray, heading: str, line: str) -> Image:
    """The frame, enlarged where it is small, with two lines of text above it."""
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(frame)
    factor = max(1, -(-SMALLEST // min(picture.size)))
    picture = picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.BICUBIC)
    size = picture.width // 26
    band = 3 * size + size % 2 + picture.height % 2  # codecs want even heights
    canvas = Image.new("RGB", (picture.width + picture.width % 2, picture.height + band), "white")
    canvas.paste(picture, (0, band))
    draw = ImageDraw.Draw(canvas)
    for place, text in enumerate((heading, line)):
        draw.text((size // 2, size // 4 + place * 1.3 * size), text, fill="black", font=ImageFont.load_default(size))
    return canvas


def _write_gif(path: Path, frames: list[Image], rate: float) -> None:
    from PIL import Image

    from fed_envs.files import atomic_file

    first, *others = (frame.quantize(_COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE) for frame in frames)
    durations = [round(1000 / rate)] * len(others) + [1000]  # ms; the end can be read
    with atomic_file(path, "wb") as file:
        first.save(file, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)


def _write_mp4(path: Path, frames: list[Image], rate: float) -> None:
    from gymnasium.utils.save_video import save_video

    pictures = [np.asarray(frame) for frame in frames]
    save_video(pictures, str(path.parent), episode_trigger=lambda _: True, name_prefix=path.stem, fps=rate, save_logger=None)
    (path.parent / f"{path.stem}-episode-0.mp4").replace(path)
