"""Compiled simulation of the motor with two masses, with exact times at which friction modes
change.

Between switches the motor is affine, `dx/dt = A x + b`, so its Taylor coefficients follow from
`c[q+1] = A c[q]/(q+1)` and the truncated series is a one-step method of order `ORDER`. A sign
change of a speed (slip ends) or a held torque beyond the friction level (stick ends) is found by
bisection on the same polynomial, so switching costs no order. State `(i_a, w_m, w_L, th_m - th_L)`;
a body is stuck exactly when its speed is 0.0 and its torque is within `a0`.
"""

from typing import no_type_check

import numpy as np

from ssm_study.compilation import compile_with_numba

# A substep's error falls with its fifth power.
ORDER = 4
SWITCHES_PER_SUBSTEP = 16  # a guard against endless switching; met twice at most in practice
BISECTIONS = 60  # below the spacing of doubles for any substep


@compile_with_numba
@no_type_check
def _torques_without_coulomb_friction(p, i, wm, wl, th, load):
    """Torques on the motor shaft and on the load, in N m, without Coulomb friction."""
    shaft = p.stiffness * th + p.damping * (wm - wl)
    return p.k * i - shaft - p.motor_viscous * wm, shaft - p.load_viscous * wl - load


@compile_with_numba
@no_type_check
def _fill_taylor_series(p, c, v, load, motor_mode, load_mode):
    """Compute the Taylor coefficients of the motor's states as functions of time, in place. Row 0
    is the state.

    A stuck body has speed zero in every row, hence exactly.
    """
    for q in range(ORDER):
        i = c[q, 0]
        wm = c[q, 1]
        wl = c[q, 2]
        th = c[q, 3]
        held_v, held_load = (v, load) if q == 0 else (0.0, 0.0)
        tm, tl = _torques_without_coulomb_friction(p, i, wm, wl, th, held_load)
        if q == 0:
            tm -= motor_mode * p.coulomb
            tl -= load_mode * p.coulomb
        part = 1.0 / (q + 1)  # c[q + 1] = (A c[q] + b) / (q + 1)
        c[q + 1, 0] = (held_v - p.resistance * i - p.k * wm) * (p.per_inductance * part)
        c[q + 1, 1] = 0.0 if motor_mode == 0 else tm * (p.per_motor_inertia * part)
        c[q + 1, 2] = 0.0 if load_mode == 0 else tl * (p.per_load_inertia * part)
        c[q + 1, 3] = (wm - wl) * part


@compile_with_numba
@no_type_check
def _evaluate_series(c, j, t):
    """Evaluate the Taylor series of one state of the motor at a given time."""
    value = c[ORDER, j]
    for q in range(ORDER - 1, -1, -1):
        value = value * t + c[q, j]  # Horner
    return value


@compile_with_numba
@no_type_check
def _friction_mode_margin(p, c, t, load, body, mode):
    """Distance of a body's motion from the end of its friction mode (sticking or sliding); negative
    once the mode has ended."""
    if mode != 0:
        return mode * _evaluate_series(c, 1 + body, t)
    tm, tl = _torques_without_coulomb_friction(
        p,
        _evaluate_series(c, 0, t),
        _evaluate_series(c, 1, t),
        _evaluate_series(c, 2, t),
        _evaluate_series(c, 3, t),
        load,
    )
    return p.coulomb - abs(tm if body == 0 else tl)


@compile_with_numba
@no_type_check
def _mode_switch_time(p, c, h, load, body, mode):
    """Time at which a body changes between sticking and sliding, by bisection; beyond the step if
    it does not change."""
    if _friction_mode_margin(p, c, h, load, body, mode) >= 0.0:
        return 2.0 * h
    low = 0.0
    high = h
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _friction_mode_margin(p, c, middle, load, body, mode) >= 0.0:
            low = middle
        else:
            high = middle
    return high


@compile_with_numba
@no_type_check
def _friction_mode(speed, torque, coulomb):
    """Friction mode of a body: 0 if it sticks, otherwise the sign of its present or beginning
    motion."""
    if speed != 0.0:
        return 1 if speed > 0.0 else -1
    if abs(torque) <= coulomb:
        return 0
    return 1 if torque > 0.0 else -1


@compile_with_numba
@no_type_check
def _advance_substep(p, c, h, v, load):
    """Advance the motor's state by one integration substep, with changes between sticking and
    sliding at exact times."""
    tm, tl = _torques_without_coulomb_friction(p, c[0, 0], c[0, 1], c[0, 2], c[0, 3], load)
    motor_mode = _friction_mode(c[0, 1], tm, p.coulomb)
    load_mode = _friction_mode(c[0, 2], tl, p.coulomb)
    for _ in range(SWITCHES_PER_SUBSTEP):
        _fill_taylor_series(p, c, v, load, motor_mode, load_mode)
        motor_leaves = _mode_switch_time(p, c, h, load, 0, motor_mode)  # which body switches first
        load_leaves = _mode_switch_time(p, c, h, load, 1, load_mode)
        t = min(h, motor_leaves, load_leaves)
        for j in range(4):
            c[0, j] = _evaluate_series(c, j, t)
        if motor_leaves > h and load_leaves > h:
            return
        h -= t  # go on from the switch
        if motor_leaves <= load_leaves:
            c[0, 1] = 0.0  # exactly: what is stuck has speed zero
            tm, _tl = _torques_without_coulomb_friction(p, c[0, 0], 0.0, c[0, 2], c[0, 3], load)
            motor_mode = _friction_mode(0.0, tm, p.coulomb if motor_mode != 0 else 0.0)
        else:
            c[0, 2] = 0.0
            _tm, tl = _torques_without_coulomb_friction(p, c[0, 0], c[0, 1], 0.0, c[0, 3], load)
            load_mode = _friction_mode(0.0, tl, p.coulomb if load_mode != 0 else 0.0)


@compile_with_numba
@no_type_check
def advance_batch(p, x, u, d, h, substeps):
    """Advance the states of a batch of simulated motors by several integration substeps under
    constant voltage and load torque.

    Under voltage `u (N, 1)` and load torque `d (N, 1)`.
    """
    out = np.empty_like(x)
    c = np.empty((ORDER + 1, 4))
    for n in range(x.shape[0]):
        volt = u[n, 0]
        v = 0.0 if abs(volt) < p.dead_zone else volt - np.sign(volt) * p.dead_zone
        c[0] = x[n]
        for _ in range(substeps):
            _advance_substep(p, c, h, v, d[n, 0])
        out[n] = c[0]
    return out
