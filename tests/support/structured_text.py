"""A reader of Structured Text that shares nothing with what writes it: it parses by the precedence of IEC 61131-3 and
checks types as strictly as compilers do, then runs a block call by call."""

import math
import re

import numpy as np

TOKEN = re.compile(
    r"\s*(?:(:=|<>|<=|>=|\.\.|[-+*/()<>=,;:\[\]&])|(\d+\.\d+(?:E[+-]?\d+)?)|(\w+#-?\d+)|(\d+)|([A-Za-z]\w*))"
)
REALS = {"LREAL": float, "REAL": np.float32}
WHOLE = {"LINT": 64, "ULINT": 64, "DINT": 32, "UDINT": 32, "INT": 16}
FUNCTIONS = {
    **{"EXP": np.exp, "LN": np.log, "SIN": np.sin, "COS": np.cos, "TAN": np.tan, "ATAN": np.arctan},
    **{"ASIN": np.arcsin, "ACOS": np.arccos, "SQRT": np.sqrt, "ABS": np.abs},
}
LEVELS = [("OR",), ("XOR",), ("AND", "&"), ("=", "<>"), ("<", ">", "<=", ">="), ("+", "-"), ("*", "/", "MOD")]


class Block:
    """One instance of a FUNCTION_BLOCK: variables by name (whatever the case), and a call."""

    def __init__(self, text: str):
        self.tokens = self._tokens(re.sub(r"\(\*.*?\*\)", " ", text, flags=re.DOTALL))
        self.at, self.types, self.values, self.inputs, self.outputs = 0, {}, {}, [], []
        self._take("FUNCTION_BLOCK")
        self.name = self._next()
        while self._peek() in ("VAR", "VAR_INPUT", "VAR_OUTPUT", "VAR_TEMP"):
            self._declarations(self._next())
        body = self._statements(("END_FUNCTION_BLOCK",))
        assert self._next() == "END_FUNCTION_BLOCK"
        assert self.at == len(self.tokens)
        environment = {"np": np, "math": math, "FUNCTIONS": FUNCTIONS, "_sel": lambda g, a, b: b if g else a}
        lines = ["def run(V):", *(f"    {line}" for line in body)]
        exec("\n".join(lines), environment)
        self._run = environment["run"]

    def __call__(self, **inputs):
        for name, value in inputs.items():
            assert name.upper() in self.inputs, name
            self.values[name.upper()] = REALS.get(self.types[name.upper()], bool)(value)
        with np.errstate(all="ignore"):
            self._run(self.values)
        commands = [self.values[name] for name in self.outputs if name != "HELD"]
        return commands[0] if self.outputs[0] == "COMMAND" else commands

    @staticmethod
    def _tokens(text):
        found, place = [], 0
        while text[place:].strip():
            match = TOKEN.match(text, place)
            assert match, text[place : place + 40]
            found.append(match[0].strip())
            place = match.end()
        return found

    def _peek(self):
        return self.tokens[self.at].upper()

    def _next(self):
        self.at += 1
        return self.tokens[self.at - 1]

    def _take(self, *words):
        for word in words:
            assert self._next().upper() == word, (word, self.tokens[self.at - 4 : self.at + 2])

    def _declarations(self, section):
        while self._peek() != "END_VAR":
            names = [self._next().upper()]
            while self._peek() == ",":
                self._next()
                names.append(self._next().upper())
            self._take(":")
            kind, size = self._next(), None
            if kind == "ARRAY":
                self._take("[", "0", "..")
                size = int(self._next()) + 1
                self._take("]", "OF")
                kind = self._next()
            zero = False if kind == "BOOL" else 0 if kind in WHOLE else REALS[kind](0)
            if self._peek() == ":=":
                self._next()
                zero = self._initial(kind)
            self._take(";")
            for name in names:
                assert name not in self.types, f"{name} is declared twice"
                assert "__" not in name
                self.types[name] = kind if size is None else (kind, size)
                self.values[name] = zero if size is None else [zero] * size
            self.inputs += names if section == "VAR_INPUT" else []
            self.outputs += names if section == "VAR_OUTPUT" else []
        self._next()

    def _initial(self, kind):
        """The value of a literal."""
        if kind == "BOOL":
            assert self._next() == "FALSE"
            return False
        sign = -1 if self._peek() == "-" and self._next() else 1
        word = self._next()
        assert kind in REALS
        assert re.fullmatch(r"\d+\.\d+(E[+-]?\d+)?", word), word
        return REALS[kind](sign * float(word))

    def _statements(self, ends):
        lines = []
        while self._peek() not in ends:
            lines += self._statement()
        return lines

    def _statement(self):
        if self._peek() == "IF":
            self._next()
            test = self._expression("BOOL")
            self._take("THEN")
            inner = self._statements(("END_IF",))
            self._take("END_IF", ";")
            return [f"if {test}:", *(f"    {line}" for line in inner)]
        if self._peek() == "FOR":
            self._next()
            name = self._next().upper()
            assert self.types[name] == "INT"
            self._take(":=")
            low = int(self._next())
            self._take("TO")
            high = int(self._next())
            self._take("DO")
            inner = self._statements(("END_FOR",))
            self._take("END_FOR", ";")
            return [f"for k in range({low}, {high} + 1):", f"    V['{name}'] = k", *(f"    {line}" for line in inner)]
        name = self._next().upper()
        assert name not in self.inputs, f"{name} is an input"
        kind, index = self.types[name], ""
        if self._peek() == "[":
            self._next()
            index = f"[{int(self._next())}]"
            self._take("]")
            kind = kind[0]
        self._take(":=")
        value = self._expression(kind)
        self._take(";")
        return [f"V['{name}']{index} = {value}"]

    def _expression(self, wanted):
        text, kind = self._level(0)
        assert kind == wanted or (kind == "number" and wanted in REALS), (text, kind, wanted)
        return text

    def _level(self, level):
        if level == len(LEVELS):
            return self._unary()
        text, kind = self._level(level + 1)
        while self._peek() in LEVELS[level]:
            sign = self._next().upper()
            other, its = self._level(level + 1)
            kind = _same(kind, its, sign)
            if sign in ("=", "<>", "<", ">", "<=", ">="):
                text, kind = f"({text} {({'=': '==', '<>': '!='}).get(sign, sign)} {other})", "BOOL"
            elif sign in ("AND", "OR", "XOR", "&"):
                assert kind == "BOOL"
                text = f"({text} {({'AND': 'and', '&': 'and', 'OR': 'or', 'XOR': '!='})[sign]} {other})"
            elif sign == "/" and kind not in WHOLE:
                text = f"np.divide({text}, {other})"
            elif sign in ("/", "MOD"):  # of whole numbers: towards zero
                assert kind in WHOLE
                text = f"math.trunc({text} / {other})" if sign == "/" else f"int(math.fmod({text}, {other}))"
            else:
                assert kind in (*REALS, "number", *WHOLE)
                text = f"({text} {sign} {other})"
        return text, kind

    def _unary(self):
        if self._peek() in ("-", "NOT"):
            sign = self._next().upper()
            text, kind = self._unary()
            assert (kind == "BOOL") == (sign == "NOT")
            return f"({'not ' if sign == 'NOT' else '-'}{text})", kind
        return self._primary()

    def _primary(self):
        word = self._next()
        if word == "(":
            text, kind = self._level(0)
            self._take(")")
            return text, kind
        if re.fullmatch(r"\d+\.\d+(E[+-]?\d+)?", word):
            return repr(float(word)), "number"
        if "#" in word:
            kind, _, value = word.partition("#")
            assert kind in WHOLE
            return f"({int(value)})", kind
        name = word.upper()
        if name in ("TRUE", "FALSE"):
            return name.capitalize(), "BOOL"
        if self._peek() == "(":
            return self._call(name)
        kind = self.types[name]
        if self._peek() == "[":
            self._next()
            index, whole = self._level(0)
            assert whole in WHOLE
            self._take("]")
            return f"V['{name}'][{index}]", kind[0]
        return f"V['{name}']", kind

    def _call(self, name):
        self._take("(")
        args = [self._level(0)]
        while self._peek() == ",":
            self._next()
            args.append(self._level(0))
        self._take(")")
        texts, kinds = zip(*args, strict=True)
        if name == "SEL":
            assert kinds[0] == "BOOL"
            return f"_sel({', '.join(texts)})", _same(kinds[1], kinds[2], "SEL")
        if name in ("EXPT", "ATAN2"):
            kind = _same(*kinds, name)
            return f"np.{'power' if name == 'EXPT' else 'arctan2'}({', '.join(texts)})", kind
        (text,), (kind,) = texts, kinds
        if match := re.fullmatch(r"([A-Z]+)_(TO|TRUNC)_([A-Z]+)", name):
            before, how, after = match.groups()
            assert kind == before or (kind == "number" and before in REALS), (name, kind)
            if after in WHOLE:
                return f"int({'np.trunc' if how == 'TRUNC' else 'np.rint'}({text}))", after
            assert how == "TO"
            return f"{'float' if after == 'LREAL' else 'np.float32'}({text})", after
        assert name in FUNCTIONS, name
        assert kind in (*REALS, "number", *(WHOLE if name == "ABS" else ()))
        return f"FUNCTIONS['{name}']({text})", kind


def _same(a, b, where):
    """The type of two, which must not be mixed; a literal is of the other's."""
    assert a == b or "number" in (a, b), (a, where, b)
    kind = b if a == "number" else a
    assert kind in (*REALS, "number") or a == b, (a, where, b)
    return kind
