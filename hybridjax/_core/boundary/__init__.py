"""What public functions take: said in their annotations, checked where users call them.

    @checked
    def fit_series(
        data: RecordedData,
        order: Order | LDTP,
        *,
        start: Literal["free", "cycle"] = "free",
        extra_lags: Index | None = None,
    ) -> SeriesFit: ...

    fit_series(data, 2, start="cold")
    # DefinitionError: fit_series: `start` must be 'free' or 'cycle', not 'cold'.

To apply it:

1. `@checked` (`checked.py`) stands first on each public function. On a public class it stands once,
   and checks the constructor and all public methods (`__call__` and `__getitem__`, too). A field
   with a converter takes what the converter's argument says.
2. Annotations say what is taken, in the words of `kinds.py` (`Order`, `Positive`, `SignalNames`,
   `Scalar`, ...), plain types, `Literal`, classes, and `Sequence`, `Mapping`, `tuple` and unions of
   them. `int` is any whole number, `float` any finite one (also an `int`, NumPy's, an array without
   axes), `Annotated[Numbers, Reals("N ny", missing=True)]` an array in which NaN may stand. What no
   word says yet is written in place, as `Annotated[float, Number("a number above 1", above=1)]`.
3. Checks by hand of single arguments go. Relations between arguments stay: two lengths that have
   to agree, names that data do not have.
4. The function gets one form: an `int`, a `float`, an array, a tuple of names.
"""
