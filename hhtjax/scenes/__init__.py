"""Scenes: systems to start from, one small file each, which return a `Scene`.

>>> import hhtjax
>>> scene = hhtjax.scenes.double_pendulum.stiff()
>>> run = hhtjax.simulate(
...     scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=scene.duration / 1000, num_steps=1000)
>>> run.check()
>>> run.q.shape
(1001, 2)

A scene of your own is a file with plain functions, `mass(q, params)` and `force(q, v, t, params)`, and at its end a
function that returns a `Scene` of them with numbers in SI units, an `InternalScene`, which has a z0 too, or an
`EventScene`, which has events. With a `drawing`, made of the shapes of `hhtjax.scenes.drawings`, it can be drawn:
`hhtjax.plot.animation(run, scene)`. The docstring gives the equations and their source; the test compares with
something that was not computed by this library: a closed form, a table in print, or SciPy.
"""

from hhtjax.scenes import arm as arm
from hhtjax.scenes import balls as balls
from hhtjax.scenes import belt as belt
from hhtjax.scenes import body_chain as body_chain
from hhtjax.scenes import bouc_wen as bouc_wen
from hhtjax.scenes import bump_stop as bump_stop
from hhtjax.scenes import double_pendulum as double_pendulum
from hhtjax.scenes import drawings as drawings
from hhtjax.scenes import dry_oscillator as dry_oscillator
from hhtjax.scenes import duffing as duffing
from hhtjax.scenes import flexible_slider_crank as flexible_slider_crank
from hhtjax.scenes import four_bars as four_bars
from hhtjax.scenes import impact_oscillator as impact_oscillator
from hhtjax.scenes import lugre as lugre
from hhtjax.scenes import maxwell as maxwell
from hhtjax.scenes import motor_joint as motor_joint
from hhtjax.scenes import pendulum as pendulum
from hhtjax.scenes import shaken_table as shaken_table
from hhtjax.scenes import slider_crank as slider_crank
from hhtjax.scenes import squeezer as squeezer
from hhtjax.scenes import top as top
from hhtjax.scenes import vehicle as vehicle
from hhtjax.scenes.scene import EventScene as EventScene
from hhtjax.scenes.scene import InternalScene as InternalScene
from hhtjax.scenes.scene import Scene as Scene
