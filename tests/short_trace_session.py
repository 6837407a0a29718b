"""The shortest session whose logs a trace can hold records out of; `then` is left to the test."""

from __future__ import annotations

SESSION = """
levid: session
name: short
seed: 5
excitations:
  psi: {input: psi, rms_n_m: 0.4}
  theta: {input: theta, rms_n_m: 0.4}
  z: {input: z, rms_n: 3.0}
steps:
  - levitate: {settle_s: 1.0}
  - record: {name: still, duration_s: 6, settle_s: 1}
  - record: {name: first, excite: [psi, theta, z], each_s: 5, settle_s: 1}
  - record: {name: second, excite: [psi, theta, z], each_s: 5, settle_s: 1}
  - land: {}
"""
