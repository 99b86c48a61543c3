"""Text whose arithmetic has one meaning: equal operations give equal bits in any function.

With the flag `contract` LLVM fuses a product with a sum where it sees fit, which depends on what
else is done with the product. A value that is computed again on the way back must decide about an
event as it did on the way there, so that there the fusing is done as the text is written.
"""

from ._text import Text, Value, is_float

_CONTRACT = " contract"


class FixedText(Text):
    """A `Text` that fuses by a rule: the first operand of a sum or difference if that is a product,
    else the second. (LLVM's `fmuladd` is one operation where the processor has it, else two.)"""

    def __init__(self, width: int):
        super().__init__(width)
        self._products: dict[str, tuple[Value, Value]] = {}

    def ordered(self, a: Value, b: Value) -> tuple[Value, Value]:
        """As they stand: names, by which they would be ordered, are others in each function."""
        return a, b

    def opaque(self, a: Value) -> Value:
        """The same number, of which it is not known that it is a product: a branch may be skipped
        in one function and be computed for all lanes in another."""
        return self.cast("bitcast", a, a.kind) if is_float(a.kind) else a

    def binary(self, operation: str, a: Value, b: Value, kind: str | None = None) -> Value:
        plain = operation.removesuffix(_CONTRACT)
        if plain == operation:
            return super().binary(operation, a, b, kind)
        if plain == "fmul":
            product = super().binary(plain, a, b)
            self._products[product.text] = a, b
            return product
        if plain in ("fadd", "fsub") and a.text in self._products:
            x, y = self._products[a.text]
            return self.intrinsic("fmuladd", x, y, b if plain == "fadd" else self._negative(b))
        if plain in ("fadd", "fsub") and b.text in self._products:
            x, y = self._products[b.text]
            return self.intrinsic("fmuladd", x if plain == "fadd" else self._negative(x), y, a)
        return super().binary(plain, a, b)

    def _negative(self, a: Value) -> Value:
        return self.value(f"fneg {self.vector(a.kind)} {a.text}", a.kind)
