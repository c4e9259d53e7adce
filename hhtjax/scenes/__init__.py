"""Scenes: example systems to start from. Each is a small file with functions that return a `Scene`.

>>> import hhtjax
>>> scene = hhtjax.scenes.double_pendulum.stiff()
>>> run = hhtjax.simulate(
...     scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=scene.duration / 1000, num_steps=1000)
>>> run.check()
>>> run.q.shape
(1001, 2)

To write a scene of your own, make a file with plain functions, `mass(q, params)` and `force(q, v, t, params)`. At its
end, a function returns a `Scene` of them with numbers in SI units. With internal states it returns an `InternalScene`,
which also has a z0; with events an `EventScene`. If the scene has a `drawing`, made of the shapes of
`hhtjax.scenes.drawings`, `hhtjax.plot.animation(run, scene)` makes a film of it. In the docstring give the equations
and their source. In a test compare with a result that was not computed by this library: a closed form, a published
table, or SciPy.
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
