"""ROS messages built from nested dicts of their fields, for writing logs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

_STAMPS = {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}
_BYTES = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}


def build(store: Typestore, type_: str, fields: Mapping[str, Any]) -> Any:
    """Build a message of a ROS type.

    Args:
        store: the type definitions.
        type_: in the spelling of ROS 2.
        fields: all fields that are not zero, in ROS 2 spelling. A stamp is a plain number of nanoseconds.
    """
    if type_ in _STAMPS:
        raise TypeError("stamps are plain numbers")
    _, described = store.fielddefs[type_]
    # ROS 1 spells CameraInfo's d, k, r and p in capitals.
    values = [_value(store, kind, fields.get(name, fields.get(name.lower()))) for name, kind in described]
    return store.types[type_](*values)


def _value(store: Typestore, kind: Any, given: Any) -> Any:
    if kind[0] == Nodetype.NAME:
        if kind[1] in _STAMPS:
            return store.types[kind[1]](*divmod(given or 0, 10**9))
        return build(store, kind[1], given or {})
    if kind[0] == Nodetype.BASE:
        return given if given is not None else ("" if kind[1][0] == "string" else 0)
    (inner, name), length = kind[1]
    if inner == Nodetype.NAME:
        return [build(store, name, item) for item in given or [{}] * length]
    if name[0] == "string":
        return list(given or [""] * length)
    dtype = _BYTES.get(name[0], name[0])
    if isinstance(given, bytes):
        return np.frombuffer(given, dtype)
    return np.zeros(length, dtype) if given is None else np.asarray(given, dtype).ravel()
