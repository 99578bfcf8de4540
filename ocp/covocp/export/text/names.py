"""Names in C: what may be one, and what becomes of names that may not."""

from __future__ import annotations

import re

from covocp.base.errors import ExportError
from covocp.base.expressions import Given

LONGEST = 40
# Of C up to C23, then of C++, whose users include the header.
_KEYWORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int long register
restrict return short signed sizeof static struct switch typedef union unsigned void volatile while _Bool _Complex
_Imaginary alignas alignof bool constexpr false nullptr static_assert thread_local true typeof typeof_unqual
and and_eq asm bitand bitor catch class char8_t char16_t char32_t co_await co_return co_yield compl concept const_cast
consteval constinit decltype delete dynamic_cast explicit export friend mutable namespace new noexcept not not_eq
operator or or_eq private protected public reinterpret_cast requires static_cast template this throw try typeid
typename using virtual wchar_t xor xor_eq
"""
KEYWORDS = frozenset(_KEYWORDS.split())
# A header of the package must not hide one of the standard library, nor its target one that CMake makes.
_RESERVED = """
assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic stdbool
stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype
main casadi all clean help install package test edit_cache rebuild_cache
"""
RESERVED = frozenset(_RESERVED.split())
# Macros of the usual headers, which a user may include before that of the package; and what the generated functions use
# themselves, whose other names end in "_".
_TAKEN = """
NULL NAN INFINITY EOF HUGE_VAL I complex imaginary errno assert stdin stdout stderr unix linux near far
isnan isinf isfinite isnormal signbit fpclassify
M_E M_LOG2E M_LOG10E M_LN2 M_LN10 M_PI M_PI_2 M_PI_4 M_1_PI M_2_PI M_2_SQRTPI M_SQRT2 M_SQRT1_2
self point workspace status memcpy all_finite
"""
TAKEN = frozenset(_TAKEN.split())


def check_name(name: Given) -> str:
    """The name of a package: an identifier in C and C++, and a file name.

    Raises:
        ExportError: it is not.
    """
    reason = ""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z](_?[A-Za-z0-9])*", name):
        reason = "letters, digits and underscores: a letter first, underscores neither at the end nor side by side"
    elif name in KEYWORDS:
        reason = "a name that is no keyword of C or C++"
    elif name.lower() in RESERVED:
        reason = "a name that no standard header and no build target has"
    elif len(name) > LONGEST:
        reason = f"at most {LONGEST} characters"
    if not reason:
        return str(name)
    raise ExportError(
        f"{name!r} cannot be the name of a C package: its functions, files and types begin with it.",
        expected=reason,
        received=repr(name),
        remedy="give another one by name=, such as 'lag_controller'",
    )


def package_name(folder: str) -> str:
    """The name of a package that is named like its folder.

    Raises:
        ExportError: it would be a keyword, or has another meaning.
    """
    return check_name(re.sub("_+", "_", identifier(folder, set(), "law")).strip("_"))


def identifier(text: str, taken: set[str], what: str = "value") -> str:
    """An identifier that resembles a text, and is not among those taken (to which it is added)."""
    plain = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_") or what
    plain = plain if plain[0].isalpha() else f"{what}_{plain}"
    plain = plain[:LONGEST]
    if plain in KEYWORDS or plain in TAKEN:
        plain = f"{plain}_"
    result, number = plain, 2
    while result in taken:
        result, number = f"{plain}_{number}", number + 1
    taken.add(result)
    return result
