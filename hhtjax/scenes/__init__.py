"""Scenes: one small file each."""

from hhtjax.scenes import arm as arm
from hhtjax.scenes import body_chain as body_chain
from hhtjax.scenes import bouc_wen as bouc_wen
from hhtjax.scenes import double_pendulum as double_pendulum
from hhtjax.scenes import duffing as duffing
from hhtjax.scenes import four_bars as four_bars
from hhtjax.scenes import lugre as lugre
from hhtjax.scenes import maxwell as maxwell
from hhtjax.scenes import motor_joint as motor_joint
from hhtjax.scenes import pendulum as pendulum
from hhtjax.scenes import slider_crank as slider_crank
from hhtjax.scenes import squeezer as squeezer
from hhtjax.scenes import top as top
from hhtjax.scenes import vehicle as vehicle
from hhtjax.scenes.scene import InternalScene as InternalScene
from hhtjax.scenes.scene import Scene as Scene
