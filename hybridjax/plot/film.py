"""Frames of an animation as images of few colors, and files of them."""

import base64
import io
import uuid
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image


_PLAYER = """<div id="{id}" style="display:inline-block;max-width:100%">
<img style="max-width:100%;background:white" width="{width}" alt="{alt}" src="{first}"><br>
<button title="pause or play">&#9199;</button>
<input type="range" min="0" max="{last}" value="0" style="width:75%;vertical-align:middle">
<script>(() => {{
const box = document.getElementById("{id}"), [image, button, slider] =
  ["img", "button", "input"].map(x => box.querySelector(x)), frames = {frames};
let playing = true;
const show = k => {{ image.src = "data:image/png;base64," + frames[k]; slider.value = k; }};
button.onclick = () => {{ playing = !playing; }};
slider.oninput = () => {{ playing = false; show(+slider.value); }};
const timer = setInterval(() => {{
  if (!box.isConnected) clearInterval(timer);
  else if (playing) show((+slider.value + 1) % frames.length);
}}, {milliseconds});
}})();</script></div>"""


def frames(
    figure: Figure, draw: Callable[[int], Sequence[Artist]], count: int, dpi: float
) -> list[Image.Image]:
    """The frames as images with one palette. Only what moves is drawn anew in each."""
    canvas, before = figure.canvas, figure.dpi
    try:
        figure.set_dpi(dpi)
        agg = FigureCanvasAgg(figure)
        moving = draw(0)
        for artist in moving:
            artist.set_animated(True)
        agg.draw()
        still, images = agg.copy_from_bbox(figure.bbox), []
        for k in range(count):
            agg.restore_region(still)
            for artist in sorted(draw(k), key=lambda x: x.get_zorder()):
                figure.draw_artist(artist)
            images.append(Image.fromarray(np.array(agg.buffer_rgba())[..., :3]))
    finally:
        figure.set_dpi(before)
        figure.set_canvas(canvas)
    few = images[:: max(1, count // 8)]
    joined = Image.fromarray(np.vstack([np.asarray(x) for x in few]))
    palette = joined.quantize(48)
    colors = np.array(palette.getpalette()).reshape(-1, 3)
    colors[colors.min(axis=1) > 248] = 255  # the paper stays white
    palette.putpalette(colors.ravel().tolist())
    return [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]


def gif(images: Sequence[Image.Image], interval: float) -> bytes:
    """A GIF that repeats. Its times are whole hundredths of a second, which together last as long
    as the frames."""
    ends = np.round(100 * interval * np.arange(len(images) + 1))
    durations = [int(10 * max(2, x)) for x in np.diff(ends)]
    options: Any = {"save_all": True, "append_images": images[1:], "duration": durations, "loop": 0}
    file = io.BytesIO()
    images[0].save(file, "gif", disposal=1, **options)
    return file.getvalue()


def player(images: Sequence[Image.Image], interval: float, alt: str) -> str:
    """HTML that shows the frames one after the other, with a button and a slider, and needs no
    other file."""
    encoded = []
    for image in images:
        file = io.BytesIO()
        image.save(file, "png", optimize=True)
        encoded.append(base64.b64encode(file.getvalue()).decode())
    return _PLAYER.format(
        id=f"motion-{uuid.uuid4().hex[:8]}", width=images[0].width * 2 // 3, alt=alt,
        first=f"data:image/png;base64,{encoded[0]}", last=len(images) - 1, frames=encoded,
        milliseconds=round(1000 * interval),
    )  # fmt: skip
