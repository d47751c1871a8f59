"""Translates a user's `.clh` text, in OpenCL C or with the habits of GLSL and HLSL, to the text that a program holds.

The user's functions compute one lane with plain numbers, so that branches, loops, tables and indices work
(`opencl.bindings` calls them lane by lane). Names are kept apart from those of our kernels: a name that the file
declares begins with `own_`, any other with `user_`, where `kernels/user.clh` defines the vocabulary for such files.
Lines stay where they were, so that a compiler's message names the line of the file.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from whitefurnace.errors import InputError

OWN, OFFERED = "own_", "user_"
"""How names begin that the file declares, and all others."""

MARK = "user's file "
"""How the name of a user's file begins in `#line`, by which a compiler's message about it is known."""

NUMBERS = ("real", "float", "double", "half", "scalar")
"""Types that stand for one number of the working precision."""

VECTORS = {
    f"{name}{count}": f"scalar{count}" for name in ("real", "float", "double", "half", "vec") for count in (2, 3, 4)
}
"""Types that stand for a vector of such numbers, with the type of the translation."""

_TYPES = {
    **dict.fromkeys(NUMBERS, "scalar"),
    **VECTORS,
    **{f"ivec{count}": f"int{count}" for count in (2, 3, 4)},
    **{f"uvec{count}": f"uint{count}" for count in (2, 3, 4)},
    **{name: name for name in ("int", "uint", "bool", "void", "char", "uchar", "short", "ushort", "long", "ulong")},
    **{f"{name}{count}": f"{name}{count}" for name in ("int", "uint") for count in (2, 3, 4)},
    **{name: name for name in ("unsigned", "signed", "size_t")},
}

_KEYWORDS = frozenset(
    "if else for while do switch case default break continue return goto const constant __constant static struct union "
    "enum typedef sizeof volatile restrict private __private __attribute__ defined true false".split()
)
_DROPPED = frozenset(("inline", "precision", "highp", "mediump", "lowp"))
_REFUSED = {
    **dict.fromkeys(("out", "inout"), "parameters that a function writes to are not read; return the value"),
    **dict.fromkeys(("mat2", "mat3", "mat4"), "matrices are not known here; write the sums out"),
    **dict.fromkeys(("kernel", "__kernel"), "write functions only; the engine calls them"),
    **dict.fromkeys(("global", "__global", "local", "__local"), "a model reads no buffers, only its parameters"),
    **dict.fromkeys(("uniform", "varying", "attribute", "layout"), "make it a parameter of the function"),
    **dict.fromkeys(("sampler2D", "samplerCube", "image2d_t"), "a model reads no images"),
    "discard": "return 0 instead",
    "asm": "assembly is not taken",
    "__asm__": "assembly is not taken",
}
_STORAGE = frozenset(("static", "const", "constant", "__constant"))
_IGNORED_DIRECTIVES = frozenset(("pragma", "version", "extension"))
_RAW_DIRECTIVES = frozenset(("error", "line"))
_DIRECTIVES = _IGNORED_DIRECTIVES | _RAW_DIRECTIVES | frozenset("define undef if ifdef ifndef elif else endif".split())

# Names of components stay as they are everywhere; no kernel defines a macro of such a name.
_COMPONENTS = re.compile(r"[xyzw]{1,4}|[rgba]{1,4}|s[0-9a-fA-F]|lo|hi|even|odd")

_TOKEN = re.compile(
    r"""(?P<comment>//(?:\\\n|[^\n])*|/\*.*?\*/)
    |(?P<open>/\*)
    |(?P<splice>\\[ \t]*\n)
    |(?P<newline>\n)
    |(?P<space>[ \t\f\v]+)
    |(?P<string>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')
    |(?P<hexfloat>0[xX][0-9a-fA-F]*\.?[0-9a-fA-F]*[pP][+-]?\d+[fFlL]?(?!\w))
    |(?P<hex>0[xX][0-9a-fA-F]+[uUlL]*(?![\w.]))
    |(?P<float>(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?(?:lf|LF|[fFhHdDlL])?(?!\w)|\d+[eE][+-]?\d+(?:lf|LF|[fFhHdDlL])?(?!\w)
        |\d+(?:lf|LF|[fFhH])(?!\w))
    |(?P<int>\d+[uUlL]*(?![\w.]))
    |(?P<number>\.?\d(?:[eEpP][+-]|[\w.])*)
    |(?P<name>[A-Za-z_]\w*)
    |(?P<sign>[{}()\[\];,.?:~!%^&*\-+=|<>/#])
    |(?P<other>.)""",
    re.VERBOSE | re.DOTALL | re.ASCII,
)


@dataclass
class Token:
    """A token of the file.

    kind: a group of `_TOKEN`. line: its line. depth: the braces around it. directive: whether it is part of a
    preprocessor line.
    """

    kind: str
    text: str
    line: int
    depth: int = 0
    directive: bool = False


_END = Token("end", "", 0)


@dataclass
class _Level:
    """What is known of a statement within its brackets: whether it declares variables, or names a type."""

    declares: bool = False
    names_type: bool = False


def decoded(raw: bytes, where: str) -> str:
    """Return the text of a file with plain line ends and without a byte-order mark; InputError where it is no text."""
    coding = "utf-16" if raw.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    try:
        text = raw.decode(coding)
    except UnicodeDecodeError:
        raise InputError(f"{where}: is not a text file") from None
    if "\0" in text:
        raise InputError(f"{where}: is not a text file")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def tokens(text: str, where: str) -> list[Token]:
    """Split the text of the file `where`; a comment becomes a space, and its line ends remain.

    Raises InputError with the line of what no model can hold: a comment or bracket that is not closed, a string, or a
    character outside ASCII.
    """
    found: list[Token] = []
    brackets: list[Token] = []
    line, depth, directive, fresh = 1, 0, False, True  # fresh: the line has held spaces only
    for match in _TOKEN.finditer(text):
        kind, part = str(match.lastgroup), match[0]
        directive = directive or (fresh and part == "#")
        token = Token(kind, part, line, depth, directive)
        line += part.count("\n")
        if kind == "open":
            raise InputError(f"{where}:{token.line}: a comment begins here with /* and is not closed")
        if kind in ("number", "other"):
            hint = "" if part.isascii() else ", which is not ASCII: write it out in letters"
            raise InputError(f"{where}:{token.line}: {part!r} cannot be read{hint}")
        if kind == "comment":
            token.text = " " + "\n" * part.count("\n")
        elif kind == "newline":
            fresh, directive = True, False
        elif kind != "space":
            fresh = False
        if kind == "sign" and not directive:
            _match_brackets(token, brackets, where)
            depth += {"{": 1, "}": -1}.get(part, 0)
        found.append(token)
    if brackets:
        raise InputError(f"{where}:{brackets[-1].line}: the {brackets[-1].text!r} of this line is not closed")
    return found


def _match_brackets(token: Token, brackets: list[Token], where: str) -> None:
    """Keep the list of open brackets; InputError where one closes that was not opened."""
    if token.text in ("(", "[", "{"):
        brackets.append(token)
    elif token.text in (")", "]", "}"):
        if not brackets:
            raise InputError(f"{where}:{token.line}: {token.text!r} closes nothing")
        opened = brackets.pop()
        if "([{".index(opened.text) != ")]}".index(token.text):
            raise InputError(
                f"{where}:{token.line}: {token.text!r} does not close the {opened.text!r} of line {opened.line}"
            )


@dataclass(frozen=True)
class Signature:
    """A function that the file defines: its name, the type that it returns, and its parameters as (type, name)."""

    name: str
    result: str
    parameters: tuple[tuple[str, str], ...]
    line: int


class UserText:
    """The tokens of a user's file, what it declares, and its translation.

    text: the file's text, with includes resolved. where: its path, for messages. Raises InputError as `tokens` does.
    """

    def __init__(self, text: str, where: str) -> None:
        self.where = where
        self._all = tokens(text, where)
        self._solid = [token for token in self._all if token.kind not in ("space", "comment", "newline", "splice")]
        self._types = set(_TYPES)
        self._functions: set[str] = set()
        self._variables: set[str] = set()
        self._members = {
            token.text
            for n, opened in enumerate(self._solid)
            if opened.text == "{" and {"struct", "union"} & {self._at(n - 1).text, self._at(n - 2).text}
            for token in itertools.takewhile(lambda token: token.text != "}", self._solid[n + 1 :])
            if token.kind == "name"
        }
        self._note_declarations()
        self._replaced = self._arrays() | self._attributes()

    def _at(self, n: int) -> Token:
        """The n-th token that is no space, or one of the kind "end" outside the text."""
        return self._solid[n] if 0 <= n < len(self._solid) else _END

    # ------------------------------------------------------------------------------------------ what it declares

    def _note_declarations(self) -> None:
        """Note the names that the file declares: functions and macros, variables, and types."""
        levels = [_Level()]
        for n, token in enumerate(self._solid):
            level, before = levels[-1], self._at(n - 1)
            if token.directive:
                if before.text == "define" and token.kind == "name":
                    self._functions.add(token.text)
                    self._variables.add(token.text)
            elif token.text in ("(", "[", "{"):
                levels.append(_Level())
            elif token.text in (")", "]", "}"):
                levels.pop()
            elif token.text == ";":
                if level.names_type and before.kind == "name":
                    self._types.add(before.text)
                    self._variables.add(before.text)
                levels[-1] = _Level()
            elif token.text == "typedef":
                level.names_type = True
            elif token.kind == "name" and token.text not in _KEYWORDS and token.text not in _TYPES:
                self._note_name(n, level)

    def _note_name(self, n: int, level: _Level) -> None:
        """Note the name that is the n-th token, where it is declared there."""
        token, before, after = self._at(n), self._at(n - 1), self._at(n + 1)
        if before.text in ("struct", "union", "enum"):
            self._types.add(token.text)
            self._variables.add(token.text)
        elif before.text in self._types or (before.text == "*" and self._at(n - 2).text in self._types):
            level.declares = after.text != "("
            (self._variables if level.declares else self._functions).add(token.text)
        elif before.text == "," and level.declares:
            self._variables.add(token.text)

    def signatures(self) -> dict[str, Signature]:
        """The functions that the file defines, by name."""
        found = {}
        for n, token in enumerate(self._solid):
            if token.kind != "name" or token.depth or token.directive or self._at(n + 1).text != "(":
                continue
            close = n + 2
            while self._at(close).kind == "name" or self._at(close).text in (",", "*"):
                close += 1
            if self._at(close).text == ")" and self._at(close + 1).text == "{":
                inside = self._solid[n + 2 : close]
                found[token.text] = Signature(
                    token.text, self._at(n - 1).text, tuple(self._parameters(inside)), token.line
                )
        return found

    @staticmethod
    def _parameters(inside: Sequence[Token]) -> Iterator[tuple[str, str]]:
        """Type and name of each parameter in the tokens between the brackets of a signature."""
        words: list[str] = []
        for token in (*inside, Token("sign", ",", 0)):
            if token.text != ",":
                if token.text not in ("const", "in", *_DROPPED):
                    words.append(token.text)
                continue
            if words and words != ["void"]:
                yield " ".join(words[:-1]), words[-1]
            words = []

    # ------------------------------------------------------------------------------------------ translation

    def translation(self) -> str:
        """Return the text that a program holds. Raises InputError with the line of what cannot be translated."""
        return "".join(self._pieces())

    def _pieces(self) -> Iterator[str]:
        n, k = 0, 0
        constants = self._constants()
        while k < len(self._all):
            token = self._all[k]
            if token.kind in ("space", "comment", "newline", "splice"):
                yield token.text
            elif token.directive and token.text == "#":
                n, k, piece = self._directive(n, k)
                yield piece
                continue
            else:
                if constants.get(n):
                    yield "constant "
                if n not in constants or token.text not in _STORAGE:
                    yield self._translated(n)
                n += 1
            k += 1

    def _directive(self, n: int, k: int) -> tuple[int, int, str]:
        """Translate a preprocessor line from its `#`, the n-th solid token and the k-th of all.

        Returns the places after it, and its text.
        """
        line = self._at(n).line
        name = self._at(n + 1).text if self._at(n + 1).directive and self._at(n + 1).line == line else ""
        if name and name not in _DIRECTIVES:
            raise InputError(f"{self.where}:{line}: #{name} is not taken in a model's file")
        left_out, text = not name or name in _IGNORED_DIRECTIVES, ""
        while k < len(self._all) and (self._all[k].directive or self._all[k].kind == "space"):
            token = self._all[k]
            if token.kind in ("space", "comment", "splice", "newline"):
                text += "\n" * token.text.count("\n") if left_out else token.text
            else:
                if not left_out:
                    text += token.text if token.text in ("#", name) or name in _RAW_DIRECTIVES else self._translated(n)
                n += 1
            k += 1
            if token.kind == "newline":
                break
        return n, k, text

    def _constants(self) -> dict[int, bool]:
        """Places of words in declarations of variables outside functions; True where one begins.

        OpenCL C asks for the address space `constant` there, which `static` and `const` do not say.
        """
        places: dict[int, bool] = {}
        for n, token in enumerate(self._solid):
            before = self._at(n - 1)
            begins = before.kind == "end" or before.directive or (not before.depth and before.text == ";")
            begins = begins or (before.text == "}" and not token.depth)
            if token.kind != "name" or token.depth or token.directive or not begins:
                continue
            end = n
            while self._at(end).kind == "name" or self._at(end).text == "*":
                end += 1
            declares = end - n > 1 and self._at(end).text in ("=", "[", ";", ",")
            if declares and token.text not in ("typedef", "struct", "union", "enum", "precision"):
                places |= {k: k == n for k in range(n, end)}
        return places

    def _arrays(self) -> dict[int, str]:
        """The tokens of arrays as GLSL has them, by place, as C has them: `{1.0, 2.0}` for `float[2](1.0, 2.0)`."""
        found: dict[int, str] = {}
        for n, token in enumerate(self._solid):
            if token.text not in self._types or self._at(n + 1).text != "[":
                continue
            close = n + 2 if self._at(n + 2).text == "]" else n + 3
            if (
                self._at(close).text == "]" and self._at(close + 1).kind == "name"
            ):  # float[3] a, which C writes float a[3]
                size = "".join(self._solid[k].text for k in range(n + 1, close + 1))
                found |= dict.fromkeys(range(n + 1, close + 1), "") | {close + 1: self._name(close + 1) + size}
            if self._at(close).text != "]" or self._at(close + 1).text != "(":
                continue
            depth, end = 1, close + 2
            while depth and self._at(end).kind != "end":
                depth += {"(": 1, ")": -1}.get(self._at(end).text, 0)
                end += 1
            found |= dict.fromkeys(range(n, close + 1), "") | {close + 1: "{", end - 1: "}"}
        return found

    def _attributes(self) -> dict[int, str]:
        """The tokens of HLSL's attributes of statements, `[unroll]`, by place: nothing in C."""
        return {
            k: ""
            for n, token in enumerate(self._solid)
            if token.text in ("unroll", "loop", "branch", "flatten")
            and (self._at(n - 1).text, self._at(n + 1).text) == ("[", "]")
            and self._at(n - 2).text in (";", "{", "}", ")", "")
            for k in (n - 1, n, n + 1)
        }

    def _translated(self, n: int) -> str:
        """The translation of the n-th solid token."""
        if n in self._replaced:
            return self._replaced[n]
        token = self._at(n)
        if token.kind == "hexfloat":
            return f"((scalar){token.text})"
        if token.kind == "float":
            digits = re.sub("(?:lf|LF|[fFhHdDlL])$", "", token.text)
            return f"USER_NUMBER({digits if re.search('[.eE]', digits) else digits + '.0'})"
        if token.kind == "string":
            raise InputError(f"{self.where}:{token.line}: {token.text} is a string, which a model cannot hold")
        return self._name(n) if token.kind == "name" else token.text

    def _name(self, n: int) -> str:
        token, before, after = self._at(n), self._at(n - 1), self._at(n + 1)
        name, called = token.text, after.text == "("
        if before.text == ".":
            known = _COMPONENTS.fullmatch(name)
            colour = known and set(name) <= set("rgba") and name not in self._members
            letters = str.maketrans("rgba", "xyzw") if colour else {}
            return name.translate(letters) if known else OWN + name
        if name in _TYPES:
            builds = called and name != "void" and self._at(n + 2).text != ")"
            return OFFERED + name if builds else _TYPES[name]
        if name in self._functions if called else name in self._variables:
            return name if _COMPONENTS.fullmatch(name) else OWN + name
        if name in _DROPPED or (name == "in" and after.kind == "name"):
            return ""
        if name in _REFUSED:
            raise InputError(f"{self.where}:{token.line}: {name!r} is not taken: {_REFUSED[name]}")
        if name in _KEYWORDS or name.startswith("__") or (_COMPONENTS.fullmatch(name) and not called):
            return name
        return OFFERED + name
