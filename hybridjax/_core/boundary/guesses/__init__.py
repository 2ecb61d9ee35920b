"""Tables of guesses: what users write who know other libraries, and the sentence that leads on.

To add a word, look for its table:

- `functions.py`: names of namespaces,
- `attributes.py`: attributes of objects,
- `keywords.py`: arguments of functions,
- `objects.py`: objects that a function needs, or is given instead,
- `synonyms.py`: other words for an argument or attribute of this package.

Each table has sentences by owner (a class, a function or a namespace; "" stands for all), with the
words that lead to them. A word stands for a whole name ("step_info"), or for a part of names: "psd"
for `plot_psd`. It also stands for its plural, and for spellings with other underscores. `words.py`
looks words up, and `leads.py` composes the sentences of errors.
"""
