"""Mutants of reading and writing files: what the tests named have to catch."""

from tests.mutants import Mutant

RADIANCE, FILES, EXR, MERL = (f"shisd/io/_{name}.py" for name in ("radiance", "files", "exr", "merl"))
HEADERS = "tests/test_io.py::test_headers_of_radiance_and_other_programs"
ROWS = "tests/test_io.py::test_rows_of_all_codes_in_one_file"
LAYERS = "tests/test_io.py::test_the_picture_among_layers_and_parts"
WRITERS = "tests/test_io.py::test_one_of_several_writers_succeeds"

MUTANTS = [
    Mutant("the last exposure counts", RADIANCE, "products[key] * numbers", "numbers + 0 * products[key]", HEADERS),
    Mutant("exposure multiplies", RADIANCE, "[:, None] / divisor", "[:, None] * divisor", HEADERS),
    Mutant("colour correction is ignored", RADIANCE, 'products["EXPOSURE"] * products["COLORCORR"]',
           'products["EXPOSURE"] * np.ones(3)', HEADERS),
    Mutant("indented lines count", RADIANCE, "        value = value.strip()\n",
           "        key, value = key.strip(), value.strip()\n", HEADERS),
    Mutant("an exposure of 0 counts", RADIANCE, "numbers[0] == 0", "numbers[0] == -1", HEADERS),
    Mutant("runs of the new code are one longer", RADIANCE, "code - 128 if run", "code - 127 if run",
           "tests/test_io.py::test_radiance_file_written_byte_by_byte"),
    Mutant("literals of the new code start one early", RADIANCE, "at + 1 - (0 if run else done)",
           "at + (1 if run else 0) - (0 if run else done)", ROWS),
    Mutant("a repeat of the old code behind another counts once", RADIANCE, "<< 8 * place", "<< 0 * place", ROWS),
    Mutant("an old repeat takes the repeat itself", RADIANCE, "pixels[repeated[used]]", "pixels[used]", ROWS),
    Mutant("the first row decides for all", RADIANCE, "new = _may_be_coded(width) and",
           "new = _may_be_coded(width) and data[:2] == start[:2] and", ROWS),
    Mutant("what is left over is not seen", RADIANCE, "next(rows, None)", "pass",
           "tests/test_io.py::test_damaged_radiance_files_are_refused"),
    Mutant("+Y is down", RADIANCE, 'signs["Y"] == "-"', 'signs["Y"] != "?"', "tests/test_io.py::test_orientations"),
    Mutant("Radiance's mantissas are cut", RADIANCE, "np.round(np.ldexp(colours", "np.floor(np.ldexp(colours",
           "tests/test_io.py::test_maps_are_written_as_they_are"),
    Mutant("the first part is the picture", EXR, "part.part_index: part for part in file.parts}[chosen.part]",
           "part.part_index: part for part in file.parts}[0]", LAYERS),
    Mutant("a layer is called like its part", EXR, "_Layer(prefix or part.name()", "_Layer(part.name() or prefix",
           LAYERS),
    Mutant("a file takes its place without the disk", FILES, "            os.fsync(file.fileno())\n", "",
           "tests/test_io.py::test_no_writer_leaves_half_a_file"),
    Mutant("the last of several writers wins", FILES, "os.link(beside, path)", "os.replace(beside, path)", WRITERS),
    Mutant("without links the last writer wins", FILES, 'path.open("xb").close()', "pass", WRITERS),
    Mutant("writing goes through a link", FILES, "    path = Path(path)\n    refuse_existing(path, overwrite)\n",
           "    path = Path(path).resolve()\n    refuse_existing(path, overwrite)\n",
           "tests/test_io.py::test_links_folders_and_modes"),
    Mutant("arrays are made before their size is known", FILES, "dtype.hasobject or size !=",
           "dtype.hasobject or 0 * size >", "tests/test_io.py::test_files_that_promise_more_than_they_hold"),
    Mutant("MERL values that no material has", MERL, "table[beyond | np.isnan(table)] = -1", "pass",
           "tests/models/test_measured.py::test_values_that_no_material_has"),
    Mutant("a file may be of any size", RADIANCE, "if size > most:", "if size < 0:",
           "tests/test_io.py::test_what_is_no_ordinary_file_or_of_no_plausible_size"),
    Mutant("examples take any folder", "examples/_scene.py", "or not any(folder.iterdir())", "or any(folder.iterdir())",
           "tests/test_io.py::test_no_example_takes_a_folder_that_it_did_not_make"),
]  # fmt: skip
