"""What goes wrong, each as one sentence."""


class PulmoError(Exception):
    """Why something cannot be read, made or run: one sentence."""


class Missing(PulmoError):
    """Why a run has nothing of a kind: one sentence."""


class RunFailed(PulmoError):
    """Why the program did not reach its end, in its own words.

    code: its exit code (1 wrong input, 2 could not go on, 3 stopped and restartable, less than 0: ended by that signal).
    directory: what it left there, if anything. output: all that it said on standard output and error.
    """

    def __init__(self, sentence, code, directory, output):
        super().__init__(sentence)
        self.code, self.directory, self.output = code, directory, output
