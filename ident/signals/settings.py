"""Settings of the way from raw channels to the rows of the regression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fri.errors import ConfigurationError

__all__ = ["SignalSettings"]


@dataclass(frozen=True)
class SignalSettings:
    """How raw channels become rows. The defaults are those of the paper, section 5.

    cutoff_hz, order : Butterworth low-pass on the positions, run forward and back. Phase is zero, the gain
        is the square of the filter's: -6 dB at `cutoff_hz`, and the roll-off of order 2 x `order`.
    decimate_hz : -6 dB frequency of the parallel low-pass, the one filter that torque and every regressor
        column pass alike, Coulomb columns included, so that it cannot bias the estimate.
    rate_hz : rate of the rows, None takes 2.5 x `decimate_hz` (decimation that keeps 80 % of the band).
    attenuation_db : stop band of the parallel low-pass.
    choose_cutoff : take `cutoff_hz` from the spectrum of the positions instead.
    average_periods : average the rows of all periods; their scatter gives the noise variance.
    edge_s : time lost at each end of an uninterrupted stretch to the transients of the Butterworth filter,
        None takes 2 / `cutoff_hz`.
    longest_bridge_s : lost samples up to this long are bridged by interpolation, a longer gap splits the
        record.
    bridged_share : a row in which bridged samples have more than this share of the filter's weight is
        dropped.
    standstill_rad_s, standstill_share : below that speed the Coulomb torque of a joint is unknown; its row
        is dropped where such samples have more than that share of the filter's weight. Share 1 keeps all.
    outlier_scale : distance from the running median, in robust standard deviations, that makes an outlier.
    motor_delay_s : how late the motor channel's times are [s], or "estimate" to find it in the data.
    delay_search_s : largest delay, either way, that is looked for.
    """

    cutoff_hz: float = 10.0
    order: int = 4
    decimate_hz: float = 2.0
    rate_hz: float | None = None
    attenuation_db: float = 40.0
    choose_cutoff: bool = False
    average_periods: bool = False
    edge_s: float | None = None
    longest_bridge_s: float = 0.02
    bridged_share: float = 0.1
    standstill_rad_s: float = 2e-3
    standstill_share: float = 0.05
    outlier_scale: float = 8.0
    motor_delay_s: float | Literal["estimate"] = "estimate"
    delay_search_s: float = 0.1

    def __post_init__(self) -> None:
        positive = ("cutoff_hz", "order", "decimate_hz", "attenuation_db", "outlier_scale", "delay_search_s")
        for name in positive:
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"`{name}` is {getattr(self, name)}, it must be positive")
        if self.decimate_hz > self.cutoff_hz:
            raise ConfigurationError(
                f"`decimate_hz` {self.decimate_hz} exceeds `cutoff_hz` {self.cutoff_hz}; the parallel "
                "filter must be the narrower one, lower `decimate_hz` or raise `cutoff_hz`"
            )
        if self.rate_hz is not None and self.rate_hz <= 0:
            raise ConfigurationError(f"`rate_hz` is {self.rate_hz}, it must be positive")

    @property
    def row_rate_hz(self) -> float:
        """Rate of the rows [Hz]."""
        return self.rate_hz if self.rate_hz is not None else 2.5 * self.decimate_hz

    @property
    def edge(self) -> float:
        """Time lost at each end to the Butterworth filter [s]."""
        return self.edge_s if self.edge_s is not None else 2.0 / self.cutoff_hz
