"""Parameters of arms over days: change points with their uncertainty, and arms unlike the others."""

from ident.monitoring.changes import Change, Series, changes, day_scatter
from ident.monitoring.unlike import Unlike, unlike

__all__ = ["Change", "Series", "Unlike", "changes", "day_scatter", "unlike"]
