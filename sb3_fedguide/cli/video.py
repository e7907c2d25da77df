"""Videos of clients' episodes: GIF by Pillow, or MP4 by moviepy, each frame written as it is drawn."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_fedguide.benchmark.rollouts import evenly, pictures, record
from sb3_fedguide.common.digits import shown

if TYPE_CHECKING:
    from PIL.Image import Image

    from fed_envs import Family
    from sb3_fedguide.benchmark.rollouts import Episode
    from sb3_fedguide.common.federation import Federation

FORMATS = ("gif", "mp4")
#: Smallest width and height of a frame in pixels.
SMALLEST = 480
#: Upper bound on frames per second. The video of a faster environment leaves frames out, and keeps its speed.
FASTEST = 34
#: Upper bound on frames of a GIF: more would make the file too large.
MAX_FRAMES = 200
_COLORS = 64


def check_format(suffix: str) -> None:
    """:raises ValueError: if its encoder is not installed"""
    if suffix == "mp4" and importlib.util.find_spec("moviepy") is None:
        raise ValueError("--video-format mp4 needs moviepy: pip install 'sb3-fedguide[video]', or take gif")


def write_videos(
    folder: Path, policy: str, algo: str, family: Family, model: Federation, seed: int, suffix: str = "gif"
) -> list[Path]:
    """One deterministic episode of each client with the model's current policies; the picture shows client and return.

    :param policy: name of the policies; part of the files' names
    :param seed: of the episodes' starts
    :return: the files
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for client in model.client_ids:
        path = folder / f"{family.name}-client{client}-{policy}.{suffix}"
        episode = record(family, client, model.client(client), seed)
        steps = frame_steps(len(episode), episode.rate, MAX_FRAMES if suffix == "gif" else None)
        heading = f"{family.name}, client {client}, {algo}: episode return {shown(episode.episode_return)}"
        frames = _captioned(family, episode, steps, heading)
        (_write_gif if suffix == "gif" else _write_mp4)(path, frames, [step / episode.rate for step in steps])
        written.append(path)
    return written


def frame_steps(length: int, rate: float, most: int | None) -> list[int]:
    """Steps after which there is a frame: evenly spaced, with the first and the last.

    :param rate: steps per second
    :param most: upper bound on frames; ``None`` for none
    """
    n_frames = length // math.ceil(rate / FASTEST) + 1
    return evenly(length, max(2, n_frames if most is None else min(n_frames, most)))


def _captioned(family: Family, episode: Episode, steps: Sequence[int], heading: str) -> Iterator[Image]:
    for step, frame in zip(steps, pictures(family, episode, steps), strict=True):
        yield caption(
            frame, heading, f"step {step} of {len(episode)}, return so far {shown(float(episode.rewards[:step].sum()))}"
        )


def caption(frame: np.ndarray, heading: str, line: str) -> Image:
    """The frame, enlarged if it is small, with two lines of text above it."""
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


def _write_gif(path: Path, frames: Iterator[Image], times: Sequence[float]) -> None:
    """:param times: of the frames, in seconds"""
    from PIL import Image

    from fed_envs.files import atomic_file

    first, *others = (frame.quantize(_COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE) for frame in frames)
    # A GIF's delays are whole hundredths of a second; rounded times, not rounded delays, keep its speed.
    durations = [*(10 * np.diff(np.round(100 * np.array(times)))).astype(int).tolist(), 1000]  # ms; the end can be read
    with atomic_file(path, "wb") as file:
        first.save(file, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)


def _write_mp4(path: Path, frames: Iterator[Image], times: Sequence[float]) -> None:
    """:param times: of the frames, in seconds, evenly spaced"""
    from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter  # Gymnasium's save_video wants all frames at once

    part = path.with_name(f".{path.stem}.part.mp4")
    first = next(frames)
    try:
        writer = FFMPEG_VideoWriter(str(part), first.size, (len(times) - 1) / (times[-1] - times[0]))
        try:
            for frame in chain([first], frames):
                writer.write_frame(np.asarray(frame))
        finally:
            writer.close()
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
