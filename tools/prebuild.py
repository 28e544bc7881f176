"""Compile the loops ahead of the first run: into wheels, or for a checkout.

python -m tools.prebuild dist     # beside the wheel in dist/, write one for this Python on Linux
                                  # x86-64, and with a cross compiler one on Linux aarch64
python -m tools.prebuild          # for this checkout: numba's cache, and with a C++ compiler the
                                  # extension module

LLVM writes code for all of its targets; the cross compiler (Debian: g++-aarch64-linux-gnu) compiles
what numba adds in C, and links. macOS is not among the targets: LLVM can write its objects, but
they are linked against Apple's own libraries, which Linux has not.

`vio/numerics/prebuilt.py` loads the module. numba's ahead-of-time compiler writes it. That takes no
options for a function, trusts the types of arguments, and takes the address of an exception for the
exception: replacements mend it while it works. It needs a C++ compiler and setuptools.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import importlib
import json
import multiprocessing
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import llvmlite.binding as llvm
from llvmlite import ir

from vio.numerics import compiled, prebuilt
from vio.numerics.compiled import Loop

# Imported without numba's types, which are incomplete; `boxing` registers what is mended here.
boxing, cgutils, types, cpu, pythonapi, numpy_support = (
    importlib.import_module(f"numba.{name}")
    for name in (
        "core.boxing",
        "core.cgutils",
        "core.types",
        "core.cpu",
        "core.pythonapi",
        "np.numpy_support",
    )
)
PythonAPI: Any = pythonapi.PythonAPI

# Recordings of a second or two, small enough that nearly all of the time goes into compiling.
_RENDERED = {
    "flight": "--rig small --width 320 --rate 10 --duration 3 --format euroc",
    "wide": "--rig fisheye --width 320 --rate 10 --duration 1.5",
    "drive": "--scene street --trajectory car --width 320 --duration 0.8",
    "depth": "--rig small --width 320 --rate 10 --duration 0.8 --format rgbd",
    # whose tracks contradict the predicted motion, as real ones do
    "shaken": "--rig small --width 320 --trajectory handheld --realism real --duration 0.5",
}
_COMMANDS = (
    "run flight --map flight.map --out mapped",
    "mesh mapped",
    "localise flight --map flight.map --out localised",
    "run flight --no-plot --out landmarks --set msckf.calibrate_stereo=off --set "
    "msckf.calibrate_camera_imu=both",
    "run wide --no-plot --out cylinder --set dataset.projection=cylinder",
    "run flight --no-plot --out mono --camera left",
    "run drive --out driven",
    "run drive --no-plot --out matched --frontend orb",
    "run depth --no-plot --out depths",
    "run shaken --no-plot --out contradicted",
)


@dataclass(frozen=True, slots=True)
class Target:
    """A kind of machine that a wheel is for."""

    machine: str  # as Python and the tags of wheels name it
    processor: str  # the oldest, LLVM's name
    features: str  # of that processor, LLVM's names; needed where this process compiles for it
    flags: str  # what a processor must have, Linux' names
    glibc: str  # the version of the oldest symbols

    @property
    def triple(self) -> str:
        """LLVM's name of the machine and its system."""
        return f"{self.machine}-unknown-linux-gnu"

    @property
    def is_here(self) -> bool:
        """Whether this machine is one."""
        return (sys.platform, platform.machine()) == ("linux", self.machine)

    @property
    def tools(self) -> str:
        """Prefix of the names of a compiler's programs."""
        return "" if self.is_here else f"{self.machine}-linux-gnu-"


TARGETS = (
    Target(
        "x86_64",
        "x86-64-v3",
        "sse3 ssse3 sse4.1 sse4.2 popcnt cx16 sahf avx avx2 bmi bmi2 f16c fma lzcnt movbe xsave",
        "pni ssse3 sse4_1 sse4_2 popcnt cx16 lahf_lm avx avx2 bmi1 bmi2 f16c fma abm movbe xsave",
        "2.2.5",
    ),
    Target("aarch64", "generic", "fp-armv8 neon", "fp asimd", "2.17"),
)
# Functions of libm of which glibc has newer versions than the targets' other symbols need.
_OLD_SYMBOLS = ("hypot",)
# The linker lets every call of such a function, also in the loops, call this one, which asks for
# the oldest version.
_OLD_SYMBOL = """
#ifdef __cplusplus
extern "C" {{
#endif
__asm__(".symver old_{name},{name}@GLIBC_{glibc}");
double old_{name}(double, double);
double __wrap_{name}(double, double) __attribute__((weak, visibility("hidden")));
double __wrap_{name}(double x, double y) {{ return old_{name}(x, y); }}
#ifdef __cplusplus
}}
#endif
"""
_OLDEST_GLIBC = 17  # minor version, of the oldest manylinux tag in use

# Bytes from the start of an object, as NumPy's and Python's headers have them: ndarray, dtype,
# type.
_TYPE = 8
_NDIM = 24
_DTYPE = 56
_FLAG_BITS = 64
_ORDER = 26
_TYPE_NUMBER = 28
_NAME = 24
_C_CONTIGUOUS = 0x1
_F_CONTIGUOUS = 0x2
_WRITEABLE = 0x400
_BYTE = ir.IntType(8)
_INT = ir.IntType(32)
_POINTER = ir.IntType(8).as_pointer()


def compile_loops() -> None:
    """Run small recordings, so that all loops of usual runs are compiled; results are thrown
    away.
    """
    from vio.cli import main as vio

    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        for name, options in _RENDERED.items():
            _check(vio(["render", "--out", f"{folder}/{name}", *options.split(), "--workers", "1"]))
        before = os.getcwd()
        os.chdir(folder)
        for command in _COMMANDS:
            _check(vio(command.split()))
        os.chdir(before)


def _check(status: int) -> None:
    if status:
        raise RuntimeError("a recording could not be processed: see above")


def write_code(
    folder: Path,
    loops: Iterable[Loop],
    processor: str,
    flags: Iterable[str],
    target: Target | None = None,
) -> None:
    """Write an extension module and its manifest into a new folder.

    Args:
        folder: of the module.
        loops: those that this process has called are written, for the types that they were called
            with.
        processor: to compile for, LLVM's name; "host" for this one.
        flags: instruction sets without which the module must not be used, Linux' names.
        target: machines of a wheel, also others than this one; None: this machine.
    """
    folder.mkdir(parents=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numba plans to replace its ahead-of-time compiler
        module = importlib.import_module("numba.pycc").CC(
            prebuilt.MODULE, source_module=prebuilt.__name__
        )
    module.target_cpu = processor
    module.output_dir = str(folder)
    places: dict[str, dict[str, Any]] = {}
    options: dict[Callable[..., Any], dict[str, Any]] = {}
    for loop in loops:
        signatures = (
            [s for s in loop.by_numba.nopython_signatures if _has_plain_types(s)]
            if loop.is_called
            else []
        )
        if not signatures:
            continue
        name = prebuilt.name_of(loop.function)
        options[loop.function] = loop.options
        symbols = [f"{name.replace('.', '_')}_{k}" for k in range(len(signatures))]
        for symbol, signature in zip(symbols, signatures, strict=True):
            module.export(symbol, signature)(loop.function)
        places[name] = {"fingerprint": loop.fingerprint, "symbols": symbols}
    environment = prebuilt.environment()
    if target is not None:
        environment["system"] = f"linux {target.machine}"
    with _mended(options), nullcontext() if target is None else _compiling_for(target, module):
        module.compile()
    (file,) = folder.glob(f"{prebuilt.MODULE}*")
    manifest = {
        "environment": environment,
        "flags": sorted(flags),
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "loops": places,
    }
    (folder / prebuilt.MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")


@contextmanager
def _compiling_for(target: Target, module: Any) -> Iterator[None]:
    """Let numba's ahead-of-time compiler write an extension module for a target, which loads with
    its oldest libraries.
    """
    toolchain: Any = importlib.import_module("numba.pycc.platform")
    codegen: Any = importlib.import_module("numba.core.codegen")
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    suffix = f".{sys.implementation.cache_tag}-{target.machine}-linux-gnu.so"
    compilers = {
        "CC": f"{target.tools}gcc",
        "CXX": f"{target.tools}g++",
        "LDSHARED": f"{target.tools}gcc -shared",
    }
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.dict(os.environ, {} if target.is_here else compilers),
        mock.patch.object(codegen.ll, "get_process_triple", return_value=target.triple),
        mock.patch.object(toolchain, "external_compiler_works", return_value=True),
        mock.patch.object(toolchain.Toolchain, "get_ext_filename", lambda _, name: name + suffix),
    ):
        header = Path(folder) / "old_symbols.h"
        header.write_text(
            "".join(_OLD_SYMBOL.format(name=name, glibc=target.glibc) for name in _OLD_SYMBOLS),
            encoding="utf-8",
        )
        wrapped = [f"-Wl,--wrap={name}" for name in _OLD_SYMBOLS]
        module._extra_cflags = {"posix": [*module._get_extra_cflags(), "-include", str(header)]}
        module._extra_ldflags = {"posix": [*module._get_extra_ldflags(), *wrapped]}
        module._toolchain = toolchain.Toolchain()
        module.output_file = prebuilt.MODULE + suffix
        yield


def tag_of(folder: Path, target: Target) -> str:
    """Return a wheel's tag: this Python, and the oldest glibc that has all symbols of its
    extension module.
    """
    (file,) = folder.glob(f"{prebuilt.MODULE}*")
    versions = {int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", file.read_bytes())}
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    return f"{python}-none-manylinux_2_{max(versions | {_OLDEST_GLIBC})}_{target.machine}"


def _has_plain_types(signature: Any) -> bool:
    """Whether no argument is a value of its own: a default, or a number written out by a caller."""
    return not any(isinstance(type_, (types.Omitted, types.Literal)) for type_ in signature.args)


@contextmanager
def _mended(options: dict[Callable[..., Any], dict[str, Any]]) -> Iterator[None]:
    """Let numba's ahead-of-time compiler use options of functions, check arguments and raise
    exceptions.
    """
    ahead_of_time: Any = importlib.import_module("numba.pycc.compiler")
    compile_extra = ahead_of_time.compile_extra
    get_c_object = PythonAPI.get_c_object
    number_long = PythonAPI.number_long
    unboxers = dict(pythonapi._unboxers.functions)

    def with_options(
        typing: Any, target: Any, function: Any, args: Any, result: Any, flags: Any, **rest: Any
    ) -> Any:
        flags = flags.copy()
        chosen = options[function]
        flags.error_model = chosen["error_model"]
        flags.release_gil = chosen["nogil"]
        flags.nrt = chosen["_nrt"]
        flags.fastmath = cpu.FastMathOptions(chosen["fastmath"])
        return compile_extra(typing, target, function, args, result, flags, **rest)

    def c_object(api: Any, name: str) -> Any:
        place = get_c_object(api, name)
        is_variable = name.startswith("PyExc_")
        return (
            api.builder.load(api.builder.bitcast(place, api.pyobj.as_pointer()))
            if is_variable
            else place
        )

    def whole_number(api: Any, number: Any) -> Any:
        function = ir.FunctionType(api.pyobj, [api.pyobj])
        return api.builder.call(api._get_function(function, "PyNumber_Index"), [number])

    def checked_array(kind: Any, argument: Any, c: Any) -> Any:
        return _if(
            _fits(kind, argument, c), kind, c, lambda: unboxers[types.Array](kind, argument, c)
        )

    def checked_none(kind: Any, argument: Any, c: Any) -> Any:
        is_none = c.builder.icmp_unsigned("==", argument, c.pyapi.borrow_none())
        return _if(is_none, kind, c, lambda: unboxers[types.NoneType](kind, argument, c))

    ahead_of_time.compile_extra = with_options
    PythonAPI.get_c_object = c_object
    PythonAPI.number_long = whole_number
    pythonapi._unboxers.functions |= {types.Array: checked_array, types.NoneType: checked_none}
    try:
        yield
    finally:
        ahead_of_time.compile_extra = compile_extra
        PythonAPI.get_c_object = get_c_object
        PythonAPI.number_long = number_long
        pythonapi._unboxers.functions |= unboxers


def _if(fits: Any, kind: Any, c: Any, unbox: Callable[[], Any]) -> Any:
    """Emit: unbox an argument of a kind where it fits, else raise TypeError."""
    value = cgutils.alloca_once(c.builder, c.context.get_value_type(kind))
    failed = cgutils.alloca_once_value(c.builder, cgutils.true_bit)
    with c.builder.if_else(fits) as (then, otherwise):
        with then:
            native = unbox()
            c.builder.store(native.value, value)
            c.builder.store(native.is_error, failed)
        with otherwise:
            c.pyapi.err_set_string("PyExc_TypeError", "an argument is of another type")
    return pythonapi.NativeValue(c.builder.load(value), is_error=c.builder.load(failed))


def _fits(kind: Any, argument: Any, c: Any) -> Any:
    """Emit: whether an argument is an array of a kind: its type, dimensions, order in memory and
    bytes.
    """
    builder = c.builder

    def field(place: Any, offset: int, type_: Any) -> Any:
        at = builder.gep(builder.bitcast(place, _POINTER), [_INT(offset)])
        return builder.load(builder.bitcast(at, type_.as_pointer()))

    def equal(a: Any, b: int) -> Any:
        return builder.icmp_unsigned("==", a, a.type(b))

    compare = c.pyapi._get_function(ir.FunctionType(_INT, [_POINTER, _POINTER]), "strcmp")
    name = c.context.insert_const_string(c.pyapi.module, "numpy.ndarray")
    is_array = equal(
        builder.call(compare, [field(field(argument, _TYPE, _POINTER), _NAME, _POINTER), name]), 0
    )
    fits = cgutils.alloca_once_value(builder, cgutils.false_bit)
    needed = {"C": _C_CONTIGUOUS, "F": _F_CONTIGUOUS, "A": 0}[
        kind.layout
    ] | _WRITEABLE * kind.mutable
    with builder.if_then(is_array):
        dtype = field(argument, _DTYPE, _POINTER)
        good = equal(builder.and_(field(argument, _FLAG_BITS, _INT), _INT(needed)), needed)
        good = builder.and_(good, equal(field(argument, _NDIM, _INT), kind.ndim))
        good = builder.and_(
            good, equal(field(dtype, _TYPE_NUMBER, _INT), numpy_support.as_dtype(kind.dtype).num)
        )
        good = builder.and_(good, builder.not_(equal(field(dtype, _ORDER, _BYTE), ord(">"))))
        builder.store(good, fits)
    return builder.load(fits)


def write_wheels(plain: Path) -> list[Path]:
    """Write wheels with machine code beside one without, one for each target that this machine has
    a compiler for, and return them.
    """
    (here,) = (target for target in TARGETS if target.is_here)
    with tempfile.TemporaryDirectory() as temporary:
        site = Path(temporary) / "site"
        code = Path(temporary) / "code"
        with zipfile.ZipFile(plain) as archive:
            archive.extractall(site)
        environment = os.environ | {
            "PYTHONPATH": str(site),
            "NUMBA_CACHE_DIR": f"{temporary}/cache",
            "NUMBA_CPU_NAME": here.processor,
            "NUMBA_CPU_FEATURES": ",".join(f"+{name}" for name in here.features.split()),
            "NUMBA_DISABLE_INTEL_SVML": "1",
        }
        subprocess.run(
            [sys.executable, __file__, "--write", str(code)], env=environment, check=True
        )
        return [
            _write_wheel(plain, site, code / target.machine, target)
            for target in TARGETS
            if (code / target.machine).is_dir()
        ]


def write_codes(folder: Path) -> None:
    """Write the machine code of each target into a folder of its name, in processes side by side,
    for the loops that this process has called.
    """
    context = multiprocessing.get_context(
        "fork"
    )  # each has the types that the loops were called for
    processes = []
    for target in TARGETS:
        if shutil.which(f"{target.tools}g++") is None:
            print(f"no wheel for {target.machine}: no {target.tools}g++ here", file=sys.stderr)
            continue
        own = folder / target.machine
        arguments = (own, compiled.LOOPS, target.processor, target.flags.split(), target)
        processes.append(context.Process(target=write_code, args=arguments))
        processes[-1].start()
    for process in processes:
        process.join()
        if process.exitcode:
            raise RuntimeError("the loops could not be compiled: see above")


def _write_wheel(plain: Path, site: Path, code: Path, target: Target) -> Path:
    """Write the wheel of one target, from the files of the plain wheel and a folder of code."""
    name, version, *_ = plain.name.split("-")
    tag = tag_of(code, target)
    made = plain.with_name(f"{name}-{version}-{tag}.whl")
    info = f"{name}-{version}.dist-info"
    record = f"{info}/RECORD"
    files = {p.relative_to(site).as_posix(): p for p in site.rglob("*") if p.is_file()}
    files |= {f"vio/numerics/{prebuilt.FOLDER.name}/{p.name}": p for p in code.iterdir()}
    lines = []
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for inside, path in sorted(files.items()):
            if inside == record or "__pycache__" in inside:
                continue
            content = path.read_bytes()
            if inside == f"{info}/WHEEL":
                content = content.replace(b"Tag: py3-none-any", f"Tag: {tag}".encode())
                content = content.replace(b"Root-Is-Purelib: true", b"Root-Is-Purelib: false")
            digest = (
                base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            )
            lines.append(f"{inside},sha256={digest},{len(content)}\n")
            _add(archive, inside, content)
        _add(archive, record, "".join([*lines, f"{record},,\n"]).encode())
    return made


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a file that everybody may read; without a date, so that equal files give equal wheels."""
    entry = zipfile.ZipInfo(name)
    entry.external_attr = 0o644 << 16
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def build_here() -> None:
    """Compile the loops of this checkout for this processor, in place of the extension module
    that it has.
    """
    final = prebuilt.FOLDER
    prebuilt.FOLDER = final.with_name(f"{final.name}.new")
    shutil.rmtree(prebuilt.FOLDER, ignore_errors=True)
    compile_loops()
    try:
        write_code(prebuilt.FOLDER, compiled.LOOPS, "host", prebuilt.processor_flags())
    except Exception as error:  # noqa: BLE001  of setuptools or the compiler, each with classes of its own
        print(
            f"no extension module ({error}): each process loads the loops from numba's cache",
            file=sys.stderr,
        )
    else:
        shutil.rmtree(final, ignore_errors=True)
        prebuilt.FOLDER.rename(final)


def main() -> int:
    """Compile for a wheel or a checkout."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dist", nargs="?", type=Path, help="a folder with the plain wheel")
    parser.add_argument("--write", type=Path, metavar="DIR", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.write:
        compile_loops()
        write_codes(args.write)
    elif args.dist:
        plain = sorted(args.dist.glob("*-py3-none-any.whl"))
        if len(plain) != 1:
            parser.error(f"{args.dist} holds {len(plain)} plain wheels; run `make wheel`")
        print(*write_wheels(plain[0]), sep="\n")
    else:
        build_here()
    return 0


if __name__ == "__main__":
    sys.exit(main())
