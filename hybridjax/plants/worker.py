"""A process that runs experiments one after the other: `python -m hybridjax.plants.worker`.

Its standard input is a stream of pickles that only the parent writes: the search path, then the
packed `Experiment`, then the seed and the inputs of each experiment. Its standard output is the
stream of answers.
"""

import os
import pickle
import sys


def main() -> None:
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a plant prints goes to standard error
    sys.path[:] = pickle.load(sys.stdin.buffer)
    packed = pickle.load(sys.stdin.buffer)

    def answer(x: object) -> None:
        pickle.dump(x, answers)
        answers.flush()

    try:
        experiment = pickle.loads(packed)
    except Exception as error:
        return answer(f"{type(error).__name__}: {error}")
    answer("")
    while True:
        try:
            seed, u = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        answer(tuple(experiment.run(seed, u)))


if __name__ == "__main__":
    main()
