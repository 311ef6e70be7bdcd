"""Field types shared by all parts of a scene."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
