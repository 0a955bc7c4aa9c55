"""What every fit returns: estimates with their uncertainty, and the model file that they make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

from cfb_mjx.parameters import ModelFile


@dataclass(frozen=True)
class Estimate:
    """One fitted quantity, SI.

    Attributes:
        value: the estimate.
        std: its standard deviation; NaN if the estimate stands at a bound.
        unit: its unit.
        preset: the value of the model that the fit started from; NaN where it has none.
    """

    value: float
    std: float
    unit: str
    preset: float


@runtime_checkable
class Fitted(Protocol):
    """The result of `fit`, `shoot`, `fit_rotors`, `by_predictions` and `by_innovations`."""

    @property
    def estimates(self) -> Mapping[str, Estimate]:
        """The identified quantities by name."""
        ...

    def model_file(self, base: ModelFile, source: str) -> ModelFile:
        """``base`` with the fitted values and their uncertainty.

        Args:
            base: the model that the fit started from.
            source: where the values come from, for the file's entries.
        """
        ...

    def to_json(self) -> dict[str, Any]:
        """The results in JSON terms."""
        ...


def numbers_of(estimates: Mapping[str, Estimate]) -> dict[str, dict]:
    """Estimates in JSON terms."""
    return {name: asdict(estimate) for name, estimate in estimates.items()}
