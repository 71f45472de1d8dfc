"""What the spectra of the motion say about the cut-off frequencies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.signals.settings import SignalSettings

__all__ = ["advice", "excitation_frequency", "optimal_cutoff"]

FloatArray = NDArray[np.float64]


def excitation_frequency(velocity: FloatArray, dt: float, share: float = 0.999) -> float:
    """Frequency [Hz] below which lies `share` of the power of the fastest-changing joint velocity.

    velocity : (n, J) low-passed, equidistant. For a Fourier excitation this is about n_f w0, its highest
        harmonic.
    """
    highest = 0.0
    power_of_joint = np.var(velocity, axis=0)
    for joint in np.flatnonzero(power_of_joint > 1e-4 * power_of_joint.max(initial=0.0)):
        frequency, power = _spectrum(velocity[:, joint], dt)
        cumulative = np.cumsum(power)
        if cumulative[-1] > 0:
            highest = max(highest, float(frequency[np.searchsorted(cumulative, share * cumulative[-1])]))
    return highest


def optimal_cutoff(position: FloatArray, dt: float, order: int = 4) -> float:
    """Cut-off [Hz] that minimises the expected square error of the accelerations, from the data.

    position : (n, J). The noise floor of each joint is the median of its spectrum's upper half; what stands
        above it is signal S. With the gain |H|^2 = 1 / (1 + (f / fc)^(2 order)) of the forward and backward
        pass, the error is the sum over f of (2 pi f)^4 [(1 - |H|^2)^2 S + |H|^4 N]; joints are weighted by
        their signal's power. The answer is bounded to 0.02 to 0.4 of the sampling rate.
    """
    rate = 1.0 / dt
    grid = np.geomspace(0.002 * rate, 0.4 * rate, 240)
    cost = np.zeros(len(grid))
    for joint in np.flatnonzero(np.ptp(position, axis=0) > 1e-2):
        frequency, power = _spectrum(position[:, joint], dt)
        floor = float(np.median(power[len(power) // 2 :]))
        signal = np.where(power > 4.0 * floor, power - floor, 0.0)
        weight = (2.0 * np.pi * frequency) ** 4
        gain = 1.0 / (1.0 + (frequency[None, :] / grid[:, None]) ** (2 * order))
        error = (weight * ((1.0 - gain) ** 2 * signal + gain**2 * floor)).sum(axis=1)
        cost += error / max(float((weight * signal).sum()), 1e-30)
    return float(grid[int(np.argmin(cost))])


def advice(
    settings: SignalSettings,
    *,
    excitation_hz: float,
    joint_rate_hz: float,
    motor_rate_hz: float | None = None,
    resonance_hz: float | None = None,
) -> tuple[str, ...]:
    """Warnings about the cut-offs against the excitation n_f w0,
    the sampling rates and the lowest resonance.
    """
    found: list[str] = []
    if settings.decimate_hz < 2.0 * excitation_hz:
        found.append(
            f"the parallel filter's cut-off {settings.decimate_hz:g} Hz is below twice the highest "
            f"excitation frequency {excitation_hz:.2f} Hz; Coriolis and gravity terms reach there, raise "
            "`decimate_hz`"
        )
    if settings.cutoff_hz < 5.0 * excitation_hz:
        found.append(
            f"the position cut-off {settings.cutoff_hz:g} Hz is below 5 x the highest excitation frequency "
            f"{excitation_hz:.2f} Hz; accelerations lose amplitude, raise `cutoff_hz`"
        )
    rates = [("joint", joint_rate_hz)] + ([("motor", motor_rate_hz)] if motor_rate_hz else [])
    for name, rate in rates:
        if settings.row_rate_hz > rate:
            found.append(
                f"rows at {settings.row_rate_hz:g} Hz exceed the {name} channel's {rate:.1f} Hz; lower "
                "`decimate_hz`"
            )
    if settings.cutoff_hz > 0.2 * joint_rate_hz:
        found.append(
            f"the position cut-off {settings.cutoff_hz:g} Hz is above a fifth of the sampling rate "
            f"{joint_rate_hz:.0f} Hz; differences lose accuracy there, lower `cutoff_hz`"
        )
    if resonance_hz is not None:
        if excitation_hz > 0.5 * resonance_hz:
            found.append(
                f"the motion reaches {excitation_hz:.2f} Hz, over half the lowest resonance "
                f"{resonance_hz:g} Hz; the joints' elasticity is excited and the rigid model is biased, "
                "plan a slower motion"
            )
        if settings.decimate_hz > 0.5 * resonance_hz:
            found.append(
                f"the parallel filter's cut-off {settings.decimate_hz:g} Hz lets the lowest resonance "
                f"{resonance_hz:g} Hz through; lower `decimate_hz`"
            )
    return tuple(found)


def _spectrum(signal: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    from scipy.signal import welch

    segment = min(len(signal), max(256, round(30.0 / dt)))
    frequency, power = welch(signal, fs=1.0 / dt, nperseg=segment, detrend="linear", window="blackmanharris")
    return frequency, power


def moving(position: FloatArray, names: Sequence[str], threshold: float = 1e-2) -> tuple[str, ...]:
    """Names of joints whose position (n, J) ranges over more than `threshold` rad."""
    return tuple(name for name, span in zip(names, np.ptp(position, axis=0), strict=True) if span > threshold)
