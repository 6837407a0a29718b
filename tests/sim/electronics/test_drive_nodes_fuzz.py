"""No frame ends the emulated CANopen drives, or makes them send an invalid one."""

from __future__ import annotations

import logging

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.sim.electronics.drive_nodes import DriveNodes
from levid.sim.electronics.emulated_rig import Electronics

RIG = shipped("rigs/canfd.yaml")
NMT, EMERGENCY, RPDO1, RPDO2, SDO, HEARTBEAT = 0x000, 0x080, 0x200, 0x300, 0x600, 0x700
"""CiA 301: function codes of frames, to which the node's number is added."""
START_ALL = b"\x01\x00"
FRAMES = st.lists(
    st.tuples(
        st.one_of(
            st.just(NMT),
            st.builds(
                int.__add__,
                st.sampled_from([EMERGENCY, RPDO1, RPDO2, SDO, HEARTBEAT]),
                st.integers(0, 4),
            ),
        ),
        st.binary(max_size=8),
    ),
    max_size=20,
)


ELECTRONICS = Electronics(load_rig(RIG), RIG.parent)
OPTIONS = load_rig(RIG).on_bus("drives")[1]
PARTS = load_rig(RIG), OPTIONS, None, ELECTRONICS.core, ELECTRONICS.injector


@settings(max_examples=settings.default.max_examples // 10)  # new drives in each
@given(FRAMES)
def test_nodes_answer_any_frames_with_valid_ones(frames: list[tuple[int, bytes]]) -> None:
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # it logs every wrong frame
    answers: list[tuple[int, bytes]] = []
    nodes = DriveNodes(*PARTS, lambda can_id, data: answers.append((can_id, data)))
    for drive in nodes.drives:
        drive._mapped = True  # as after the host's start-up
    for can_id, data in [(NMT, START_ALL), *frames]:
        nodes.handle_frame(can_id, data)
        answers += nodes.sync()
    assert all(len(data) <= 8 and 0 <= can_id < 0x800 for can_id, data in answers)
    assert np.isfinite(ELECTRONICS.core.motion).all()
