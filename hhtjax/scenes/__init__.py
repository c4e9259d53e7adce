"""Scenes: one small file each."""

from hhtjax.scenes import arm as arm
from hhtjax.scenes import double_pendulum as double_pendulum
from hhtjax.scenes import duffing as duffing
from hhtjax.scenes import vehicle as vehicle
from hhtjax.scenes.scene import Scene as Scene
