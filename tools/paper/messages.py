"""What the tool tells while it works."""
import sys


def fail(message):
    sys.exit(f"reproduce_paper: error: {message}")


def say(message):
    print(f"reproduce_paper: {message}", flush=True)
