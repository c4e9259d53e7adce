"""Makes README.md, the gallery, from the list of pictures.

python -m experiments.scenes.page
"""

from pathlib import Path

from experiments.scenes.scenes import PICTURES

HERE = Path(__file__).parent
HEAD = """# Gallery of scenes

Systems to start from: each has parameters, a start and a duration, in SI units. Choose one, run it, and draw it:

```python
import hhtjax

scene = hhtjax.scenes.double_pendulum.free()
dt = scene.duration / 1000
run = hhtjax.simulate(scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=dt, num_steps=1000)
hhtjax.plot.animation(run, scene).save("double_pendulum.gif")
```

If a scene has events, also pass `events=scene.events`; if it has internal states, pass `z0=scene.z0`. If a picture
shows several times, the earlier ones are paler. A sketch above a curve shows the state at the dot. Equations and
parameters are in [the reference](../../docs/api/scenes.rst). `python -m experiments scenes` draws the pictures.
"""


def entry(name: str) -> str:
    """Title, picture, sentence, links."""
    picture = PICTURES[name]
    links = f"[Reference](../../docs/api/scenes.rst), [code](../../hhtjax/scenes/{name}.py)."
    return f"## {name}\n\n![{picture.text}](scenes_{name}.png)\n\n{picture.text} {links}"


def page() -> str:
    """The text of README.md."""
    return "\n\n".join([HEAD.rstrip("\n"), *map(entry, PICTURES)]) + "\n"


if __name__ == "__main__":
    (HERE / "README.md").write_text(page())
