"""An emulator configuration tried without a socket: every file that it names is read, every entry is checked."""

from __future__ import annotations

from fri.errors import ConfigurationError, LwrError
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import EmulatorConfig
from sim_backend.faults import FaultyWire
from sim_backend.operator import Operator
from sim_backend.plant import CYCLE_S


def rehearse(config: EmulatorConfig) -> None:
    """Build the cabinet of a configuration with its faults, schedule and KRL program, and drop it.

    Raises ConfigurationError if it cannot be emulated.
    """
    try:
        cabinet = Cabinet(config)
        Operator(cabinet, FaultyWire(cabinet.wire_seed, cabinet.period_ms * CYCLE_S))
    except LwrError:
        raise
    except (ArithmeticError, ValueError, TypeError, LookupError, RuntimeError, OSError) as error:
        plugins = [*config.robot.effects, *([config.robot.plant] if config.robot.plant else [])]
        outside = f" or the outside classes {', '.join(plugin.type for plugin in plugins)}" if plugins else ""
        raise ConfigurationError(
            f"{config.source}: cannot be emulated: {type(error).__name__}: {error!s:.200}; compare it with "
            f"configs/emulator/default.yaml{outside and ', check' + outside.removeprefix(' or')}"
        ) from error
