import subprocess
import sys

CODE = """
import sys
import triquad_client
heavy = {"torch", "numba", "skimage", "scipy", "triquad_server"} & set(sys.modules)
sys.exit(f"importing the client brought in {heavy}" if heavy else 0)
"""


def test_client_comes_without_the_server_and_its_libraries():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


PREVIEW_CODE = """
import sys
import triquad_client, triquad_map.stored_map
loaded = [name for name in sys.modules if name.startswith(("google.", "foxglove"))]
sys.exit(f"reading a map brought in {loaded}" if loaded else 0)
"""


def test_reading_a_map_comes_without_what_previews_are_written_with():
    done = subprocess.run([sys.executable, "-c", PREVIEW_CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_all_public_names_exist():
    import triquad_client

    for name in triquad_client.__all__:
        assert getattr(triquad_client, name) is not None


def test_a_tool_whose_libraries_are_missing_says_what_to_install():
    code = (
        "import sys; sys.modules['numba'] = None; sys.argv = ['triquad-demo']\n"
        "from triquad_tools.commands import entry_points\n"
        "sys.exit(entry_points.demo())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert "is missing: install triquad[tools]" in done.stderr
    assert "Traceback" not in done.stderr
