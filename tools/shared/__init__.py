"""What all tools share. The Python module `pulmo`, which reads runs for them, too, is found from here on."""
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "python"))
