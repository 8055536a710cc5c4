"""Frozen dataclasses that are pytrees: fields are traced leaves unless marked `static`."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

Class = TypeVar("Class")


def static(**keywords: Any) -> Any:
    """Field that belongs to the structure: compared and hashed, never traced."""
    return dataclasses.field(metadata={"static": True}, **keywords)


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def pytree(cls: type[Class]) -> type[Class]:
    """Class decorator: frozen dataclass registered with JAX, immutable, `dataclasses.replace` works."""
    cls = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    jax.tree_util.register_dataclass(
        cls,
        data_fields=[field.name for field in fields if not field.metadata.get("static")],
        meta_fields=[field.name for field in fields if field.metadata.get("static")],
    )
    return cls
