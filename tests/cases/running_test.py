#!/usr/bin/python3
"""What surrounds a run (docs/running.md): the exit code."""
import os
import signal
import subprocess
import time
import unittest

import pulmo_case as pulmo

GOOD = pulmo.CUBE + pulmo.PCV + pulmo.DIRECT + ["-airflow_surfaces", "airway", "-progress", "off"]
SHORT = ["-ts_max_time", "0.1"]
# a pull that no step survives
TOO_MUCH = ["-ventilator_pip", "1e6", "-ts_adapt_dt_min", "0.01"]
LONG = ["-ventilator_expiration", "5000"]


class ExitCodes(unittest.TestCase):
    """0 finished, 1 wrong input, 2 could not go on, 3 stopped by a signal and restartable."""

    def codes(self, options, ranks=2, stop=None):
        """The exit code of each rank, of the launcher, and what was said. `stop`: a signal, once there are rows."""
        folder = pulmo.scratch("codes")
        os.mkdir(folder)
        # so that no rank is stopped by the launcher before its code is known
        run = '"$@"; echo $? > ' + folder + "/$OMPI_COMM_WORLD_RANK; exit 0"
        command = pulmo.LAUNCHER + [str(ranks), "sh", "-c", run, "sh", pulmo.PROGRAM] + options
        process = subprocess.Popen(command + ["-output_dir", folder + "/run"], cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT,
                                   text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        if stop:
            self.send_in_time(stop, folder + "/run", command[-len(options) - 1])
        _, err = process.communicate(timeout=120)
        found = {}
        for rank in range(ranks):
            with open(os.path.join(folder, str(rank))) as f:
                found[rank] = int(f.read())
        return [found[rank] for rank in range(ranks)], err

    @staticmethod
    def wait_for_rows(directory):
        path, end = os.path.join(directory, "signals.csv.part"), time.monotonic() + 60
        while time.monotonic() < end:
            if os.path.exists(path):
                with open(path) as f:
                    if len(f.readlines()) > 3:
                        return
            time.sleep(0.01)
        raise AssertionError("no rows")

    def send_in_time(self, stop, directory, program):
        self.wait_for_rows(directory)
        listed = subprocess.run(["ps", "-eo", "pid=,args="], text=True, stdout=subprocess.PIPE).stdout.splitlines()
        ranks = [line.split()[0] for line in listed if line.split()[1] == program and directory in line]
        self.assertTrue(ranks)
        os.kill(int(ranks[0]), stop)

    def test_every_rank_ends_with_the_code_of_the_kind(self):
        for options, code, stop in ((SHORT, 0, None), (["-tissue", "jelly"], 1, None), (TOO_MUCH, 2, None),
                                    (LONG, 3, signal.SIGUSR1)):
            with self.subTest(code):
                codes, err = self.codes(GOOD + options, stop=stop)
                self.assertEqual(codes, [code, code], err)
                self.assertEqual(err.count("pulmo: error:"), code > 0, err)

    def test_the_launcher_passes_it_on(self):
        for options, code in ((SHORT, 0), (["-tissue", "jelly"], 1), (TOO_MUCH, 2)):
            for ranks in (1, 2):
                with self.subTest(code, ranks=ranks):
                    case = pulmo.Case(GOOD + options, ranks=ranks, launch=True)
                    self.assertEqual(case.code, code, case.tail())
        directory = pulmo.scratch()
        process = subprocess.Popen(pulmo.LAUNCHER + ["2", pulmo.PROGRAM] + GOOD + LONG + ["-output_dir", directory],
                                   cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT, text=True, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE)
        self.wait_for_rows(directory)
        process.send_signal(signal.SIGUSR1)
        _, err = process.communicate(timeout=60)
        self.assertEqual(process.returncode, 3, err)
        self.assertIn("checkpoint.h5", os.listdir(directory))

    def test_a_crash_is_could_not_go_on(self):
        """Signals that a fault of the program raises, and those that arrive before a run heeds any."""
        for sent in (signal.SIGSEGV, signal.SIGFPE, signal.SIGABRT):
            with self.subTest(sent):
                directory = pulmo.scratch()
                process = subprocess.Popen([pulmo.PROGRAM] + GOOD + LONG + ["-output_dir", directory], cwd=pulmo.SOURCE,
                                           env=pulmo.ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                                           text=True)
                self.wait_for_rows(directory)
                process.send_signal(sent)
                _, err = process.communicate(timeout=60)
                self.assertEqual(process.returncode, 2, err)
                self.assertIn("signal %d" % sent, err)

    def test_help_tells_them(self):
        case = pulmo.finished(["-help"])
        self.assertIn("0 finished, 1 wrong input, 2 could not go on, 3 stopped by a signal", case.out)


if __name__ == "__main__":
    pulmo.main()
