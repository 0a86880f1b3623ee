"""Meanings of the fields of dataclasses, read from their docstrings."""

from __future__ import annotations

import inspect

from docstring_parser import DocstringStyle, parse


def attribute_meanings(cls: type) -> dict[str, str]:
    """Field name to sentence, from ``Attributes:`` in the Google-style docstrings of a class and its base classes.

    >>> class Size:
    ...     '''Extent.
    ...
    ...     Attributes:
    ...         height: extent along z, in
    ...             ``metres``.
    ...     '''
    >>> attribute_meanings(Size)
    {'height': 'extent along z, in metres.'}
    """
    meanings: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        for entry in parse(inspect.cleandoc(base.__doc__ or ""), style=DocstringStyle.GOOGLE).params:
            if entry.args[0] == "attribute":
                meanings[entry.arg_name] = " ".join((entry.description or "").replace("``", "").split())
    return meanings
