"""Base parameters: the smallest set of combinations of the standard parameters that the torques depend on.

Two routes that share nothing but the bookkeeping: `numeric_base` (rank of sampled observation matrices) and
`closed_form_base` (the rules of Khalil, Bennis and Gautier on the modified-DH constants). Both give a
`BaseSet`.
"""

from ident.base.base_set import BaseSet, columns_by_preference
from ident.base.closed_form import closed_form_base
from ident.base.numeric import numeric_base

__all__ = ["BaseSet", "closed_form_base", "columns_by_preference", "numeric_base"]
