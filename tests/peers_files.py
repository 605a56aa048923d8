#!/usr/bin/env python3
"""Writes small volumes with the peers' own writers, and compares what slabcast reads.

    python3 -m venv venv && venv/bin/pip install nibabel SimpleITK pynrrd tifffile imagecodecs zarr pydicom vtk h5py netCDF4 \
        pylibjpeg pylibjpeg-openjpeg
    venv/bin/python tests/peers_files.py target/debug/slabcast

Each file holds 7x5x3 numbers of one type. `slabcast convert` writes it as raw NRRD, whose samples must
be the peer's to the bit, in the file's type; `slabcast info --json` gives steps and origin, which must
be the peer's in RAS. Files of several volumes are read by `--volume`, `--time` and `--channel`. A peer
that is not installed is named, and its files are left out. Files of two axes have to be refused as
pictures. Exits with 1 if a file differs.
"""

import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile

import numpy as np

DIMS = (7, 5, 3)
TYPES = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]
NRRD = {"uint8": "u1", "int8": "i1", "uint16": "u2", "int16": "i2", "uint32": "u4", "int32": "i4",
        "uint64": "u8", "int64": "i8", "float": "f4", "double": "f8"}
PEERS = ["h5py", "netCDF4", "numpy", "nibabel", "SimpleITK", "nrrd", "tifffile", "zarr", "pydicom", "vtk"]
peer = {}
counts = {}


def numbers(kind, more=()):
    """Numbers over the whole range of a type, x fastest: shape (7, 5, 3, *more)."""
    rng = np.random.default_rng(7)
    shape = DIMS + tuple(more)
    if np.dtype(kind).kind == "f":
        a = rng.normal(size=shape) * 1e6
    else:
        limits = np.iinfo(kind)
        a = rng.integers(limits.min, limits.max, size=shape, dtype=kind, endpoint=True)
    return np.asfortranarray(a.astype(kind))


def run(*args):
    return subprocess.run([SLABCAST, *args], capture_output=True, text=True)


def samples(path):
    """Samples of a raw NRRD that slabcast wrote, shape (x, y, z)."""
    head, data = open(path, "rb").read().split(b"\n\n", 1)
    fields = dict(l.split(": ", 1) for l in head.decode().splitlines() if ": " in l)
    sizes = [int(n) for n in fields["sizes"].split()]
    return np.frombuffer(data, "<" + NRRD[fields["type"]]).reshape(sizes, order="F")


def check(writer, path, want, *flags, steps=None, origin=None):
    """Compares a file: samples to the bit, and steps (rows i, j, k) and origin in RAS, if given."""
    row = counts.setdefault(writer, [0, 0, 0])
    said = run("convert", path, "out.nrrd", "--encoding", "raw", "--force", *flags)
    name = f"{writer} {path} {want.dtype} {' '.join(flags)}"
    if said.returncode:
        row[2] += 1
        print(f"refused: {name}: {said.stderr.strip()[:200]}")
        return
    got = samples("out.nrrd")
    same = got.dtype == want.dtype and np.array_equal(got, want, equal_nan=want.dtype.kind == "f")
    if same and steps is not None:
        said = run("info", path, "--json", *flags)
        if said.returncode:
            sys.exit(f"{name}: info fails after convert: {said.returncode} {said.stderr}")
        info = json.loads(said.stdout)
        same = np.allclose(info["steps"], steps, rtol=1e-6, atol=1e-6)
        same = same and np.allclose(info["origin"], origin, rtol=1e-6, atol=1e-5)
    row[0 if same else 1] += 1
    if not same:
        print(f"DIFFERS: {name}: {got.dtype} {got.ravel('F')[:3]}, want {want.ravel('F')[:3]}")


def near(writer, path, want, most):
    """Checks that samples differ from those of a codec with loss by `most` at most."""
    row = counts.setdefault(writer, [0, 0, 0])
    said = run("convert", path, "out.nrrd", "--encoding", "raw", "--force")
    if said.returncode:
        row[2] += 1
        print(f"refused: {writer} {path}: {said.stderr.strip()[:200]}")
        return
    got = samples("out.nrrd")
    far = np.abs(got.astype("f8") - want.astype("f8")).max() if got.shape == want.shape else np.inf
    row[0 if far <= most else 1] += 1
    if far > most:
        print(f"DIFFERS: {writer} {path}: by {far}, {got.shape}, {want.shape}")


def refuse(writer, path, say):
    """Checks that a file is refused in these words."""
    row = counts.setdefault(writer, [0, 0, 0])
    said = run("info", path)
    right = said.returncode == 1 and say in said.stderr
    row[0 if right else 1] += 1
    if not right:
        print(f"DIFFERS: {writer} {path}: {said.returncode} {said.stderr.strip()[:200]}")


def nibabel():
    nib = peer["nibabel"]
    turned = np.array([[0, -2, 0, 31.5], [1.5, 0, 0, -12.25], [0, 0, 3, 107.75], [0, 0, 0, 1]])
    for kind in TYPES:
        for make in (nib.Nifti1Image, nib.Nifti2Image):
            for order in "<>":
                a = numbers(kind)
                image = make(a, turned, dtype=a.dtype)
                image = make(a, turned, image.header.as_byteswapped(order), dtype=a.dtype)
                for name in ("a.nii", "a.nii.gz"):
                    nib.save(image, name)
                    affine = nib.load(name).affine
                    check("nibabel", name, a, steps=affine[:3, :3].T, origin=affine[:3, 3])
        a = numbers(kind, (4,))
        nib.save(nib.Nifti1Image(a, turned, dtype=a.dtype), "t.nii.gz")
        for n in (0, 3):
            check("nibabel, times", "t.nii.gz", a[..., n], "--volume", str(n))
        if kind in ("u1", "i2", "i4", "f4"):  # FreeSurfer's types
            for name in ("a.mgh", "a.mgz"):
                nib.save(nib.MGHImage(a, turned), name)
                affine = nib.load(name).affine
                for n in (0, 3):
                    check("nibabel, FreeSurfer", name, a[..., n], "--time", str(n),
                          steps=affine[:3, :3].T, origin=affine[:3, 3])
        nib.save(nib.Nifti1Image(a[:, :, 0, 0], turned, dtype=a.dtype), "flat.nii")
        refuse("nibabel, two axes", "flat.nii", "is a 2-D picture of 7 x 5, not a volume")


def SimpleITK():
    itk = peer["SimpleITK"]
    turned = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    flip = np.array([-1.0, -1.0, 1.0])
    for kind in TYPES:
        a = numbers(kind)
        image = itk.GetImageFromArray(np.ascontiguousarray(a.transpose(2, 1, 0)))
        image.SetSpacing((0.7, 1.3, 2.9))
        image.SetOrigin((31.5, -12.25, 107.75))
        image.SetDirection(turned)
        steps = (np.array(turned).reshape(3, 3) * (0.7, 1.3, 2.9)).T * flip
        origin = np.array(image.GetOrigin()) * flip
        for name in ("a.mha", "a.mhd", "a.nrrd", "a.nhdr", "a.nii", "a.nii.gz"):
            for packed in (False, True):
                itk.WriteImage(image, name, packed)
                check("SimpleITK", name, a, steps=steps, origin=origin)
        a = numbers(kind, (3,))
        several = np.ascontiguousarray(a.transpose(3, 2, 1, 0))
        itk.WriteImage(itk.GetImageFromArray(several, isVector=False), "t.mha")
        itk.WriteImage(itk.GetImageFromArray(several, isVector=False), "t.nrrd")
        several = np.ascontiguousarray(a.transpose(2, 1, 0, 3))
        itk.WriteImage(itk.GetImageFromArray(several, isVector=True), "v.mha")
        itk.WriteImage(itk.GetImageFromArray(several, isVector=True), "v.nrrd")
        for n in (0, 2):
            for name in ("t.mha", "t.nrrd"):
                check("SimpleITK, volumes", name, a[..., n], "--volume", str(n))
            for name in ("v.mha", "v.nrrd"):
                check("SimpleITK, vectors", name, a[..., n], "--channel", str(n))


        flat = itk.GetImageFromArray(np.ascontiguousarray(a[:, :, 0, 0].T))
        for name in ("flat.nrrd", "flat.mha", "flat.nii"):
            itk.WriteImage(flat, name)
            refuse("SimpleITK, two axes", name, "is a 2-D picture of 7 x 5, not a volume")


def nrrd():
    for kind in TYPES:
        a = numbers(kind)
        for encoding in ("raw", "gzip", "bzip2", "ascii"):
            head = {"encoding": encoding, "space": "left-posterior-superior",
                    "space directions": [[0, 2, 0], [-1.5, 0, 0], [0, 0, 3]],
                    "space origin": [31.5, -12.25, 107.75]}
            if encoding == "ascii" and kind in ("u8", "i8", "f4", "f8"):
                continue  # its text has fewer digits
            for name in ("a.nrrd", "a.nhdr"):
                peer["nrrd"].write(name, a, head)
                steps = np.array(head["space directions"]) * (-1, -1, 1)
                check("pynrrd", name, a, steps=steps, origin=[-31.5, 12.25, 107.75])
        a = numbers(kind, (4,))
        peer["nrrd"].write("l.nrrd", a, {"kinds": ["domain"] * 3 + ["list"]})
        check("pynrrd, list", "l.nrrd", a[..., 2], "--volume", "2")
        a = numbers(kind)
        peer["nrrd"].write("r.nrrd", a, {"axis mins": [0, 1, 2], "axis maxs": [14, 11, 3.5],
                                         "centerings": ["cell"] * 3})
        check("pynrrd, axis mins", "r.nrrd", a, steps=np.diag((2, 2, 0.5)), origin=(1, 2, 2.25))


def tifffile():
    for kind in TYPES:
        a = numbers(kind)
        pages = np.ascontiguousarray(a.transpose(2, 1, 0))
        for packed in (None, "zlib", "lzw"):
            for order in "<>":
                try:
                    peer["tifffile"].imwrite("a.tif", pages, compression=packed, byteorder=order,
                                             photometric="minisblack")
                except (ImportError, KeyError, ValueError):
                    continue
                check("tifffile", "a.tif", a)
        a = numbers(kind, (2,))
        pages = np.ascontiguousarray(a.transpose(2, 3, 1, 0))
        peer["tifffile"].imwrite("c.tif", pages, metadata={"axes": "ZCYX"}, photometric="minisblack")
        names = ["c.tif"]
        if kind not in ("u8", "i8"):  # OME has no such type
            peer["tifffile"].imwrite("c.ome.tif", pages, metadata={"axes": "ZCYX"},
                                     photometric="minisblack")
            names.append("c.ome.tif")
        for name in names:
            check("tifffile, channels", name, a[..., 1], "--channel", "1")


        a = numbers(kind, (3,))
        for planar in ("contig", "separate"):
            axes = (2, 1, 0, 3) if planar == "contig" else (2, 3, 1, 0)
            for packed in (None, "zlib"):
                peer["tifffile"].imwrite("rgb.tif", np.ascontiguousarray(a.transpose(axes)),
                                         photometric="rgb", planarconfig=planar, compression=packed)
                for n in (0, 2):
                    check("tifffile, colours", "rgb.tif", a[..., n], "--channel", str(n))
    a = (numbers("f4") / 100).astype("f2")
    for packed in (None, "zlib"):
        for order in "<>":
            pages = np.ascontiguousarray(a.transpose(2, 1, 0))
            peer["tifffile"].imwrite("h.tif", pages, compression=packed, byteorder=order,
                                     photometric="minisblack")
            check("tifffile, float16", "h.tif", a.astype("f4"))


def zarr():
    import numcodecs as n
    for kind in TYPES + ["f2", "b1"]:
        a = numbers("u1") % 2 == 1 if kind == "b1" else numbers("f4" if kind == "f2" else kind)
        a = np.asfortranarray((a / 100 if kind == "f2" else a).astype(kind))
        want = a.astype({"f2": "f4", "b1": "u1"}.get(kind, kind))
        codecs = [n.BZ2(), n.LZMA(), n.Zlib(), n.GZip(), n.LZ4(), n.Zstd(), n.Blosc()]
        filters = [None, [n.Shuffle(np.dtype(kind).itemsize)]]
        if kind not in ("f2", "b1"):
            filters.append([n.Delta(f"<{kind}" if np.dtype(kind).itemsize > 1 else f"|{kind}")])
        for codec in codecs:
            for chosen in filters:
                z = peer["zarr"].create_array("n.zarr", shape=DIMS[::-1], chunks=(2, 3, 4),
                                              dtype=kind, zarr_format=2, overwrite=True,
                                              filters=chosen, compressors=codec)
                z[:] = a.transpose(2, 1, 0)
                # Sums of differences of floats round, in zarr as in slabcast.
                back = np.asfortranarray(z[:].transpose(2, 1, 0)).astype(want.dtype)
                check("zarr, numcodecs", "n.zarr", back)
    for kind in TYPES:
        for version in (2, 3):
            for chunks in ((3, 5, 7), (2, 2, 4)):
                a = numbers(kind)
                z = peer["zarr"].create_array("a.zarr", shape=DIMS[::-1], chunks=chunks, dtype=kind,
                                              zarr_format=version, overwrite=True)
                z[:] = a.transpose(2, 1, 0)
                check("zarr", "a.zarr", a)
        a = numbers(kind, (3,))
        z = peer["zarr"].create_array("c.zarr", shape=(3, 3, 5, 7), chunks=(2, 2, 5, 7), dtype=kind,
                                      overwrite=True, dimension_names=["c", "z", "y", "x"])
        z[:] = a.transpose(3, 2, 1, 0)
        check("zarr, channels", "c.zarr", a[..., 2], "--channel", "2")
        ours(kind)


def ours(kind):
    """OME-Zarr that slabcast writes, read by zarr: level 0 to the bit, and the levels' sizes and scales."""
    x, y, z = 130, 67, 5
    a = np.resize(numbers(kind).ravel(order="F"), x * y * z).reshape(z, y, x)
    a[:, :, 64:128] = 0
    name = f"ours_{x}x{y}x{z}_{np.dtype(kind).name}.raw"
    a.astype(np.dtype(kind).newbyteorder("<")).tofile(name)
    row = counts.setdefault("zarr, written by slabcast", [0, 0, 0])
    said = run("convert", name, "ours.ome.zarr", "--spacing", "0.5x0.5x2", "--force", "-q")
    if said.returncode:
        row[2] += 1
        print(f"refused: {name}: {said.stderr.strip()[:200]}")
        return
    group = peer["zarr"].open_group("ours.ome.zarr", mode="r")
    image = group.attrs["ome"]["multiscales"][0]
    levels = [group[d["path"]] for d in image["datasets"]]
    scales = [d["coordinateTransformations"][0]["scale"] for d in image["datasets"]]
    same = levels[0].dtype == np.dtype(kind) and levels[0][:].tobytes() == a.tobytes()
    same = same and [level.shape for level in levels] == [(5, 67, 130), (5, 34, 65), (5, 17, 33)]
    same = same and scales == [[2, 0.5, 0.5], [2, 1, 1], [2, 2, 2]]
    if kind == "u1":
        corners = [a[:, j:66:2, i::2].astype(int) for j in (0, 1) for i in (0, 1)]
        same = same and np.array_equal((sum(corners) + 2) // 4, levels[1][:, :33, :])
    row[0 if same else 1] += 1
    if not same:
        print(f"DIFFERS: {name}: {levels[0].dtype} {[l.shape for l in levels]} {scales}")


def pydicom():
    import pydicom as pydicom_module
    import pydicom.data
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
    for kind in ("u1", "u2", "i2"):
        a = numbers(kind, (2,))
        os.makedirs(f"dicom_{kind}", exist_ok=True)
        series = generate_uid()
        for t in range(2):
            for k in range(3):
                meta = FileMetaDataset()
                meta.MediaStorageSOPClassUID = CTImageStorage
                meta.MediaStorageSOPInstanceUID = generate_uid()
                meta.TransferSyntaxUID = ExplicitVRLittleEndian
                d = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
                d.SOPClassUID, d.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
                d.Modality, d.SeriesInstanceUID, d.SeriesNumber = "MR", series, 1
                d.InstanceNumber = 3 * t + k + 1
                d.ImagePositionPatient = [31.5, -12.25, 2.5 * k]
                d.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
                d.PixelSpacing, d.SliceThickness = [1.25, 0.75], 2.5
                d.SamplesPerPixel, d.PhotometricInterpretation = 1, "MONOCHROME2"
                d.Rows, d.Columns = DIMS[1], DIMS[0]
                d.BitsAllocated = d.BitsStored = 8 * np.dtype(kind).itemsize
                d.HighBit = d.BitsStored - 1
                d.PixelRepresentation = int(np.dtype(kind).kind == "i")
                d.PixelData = np.ascontiguousarray(a[:, :, k, t].T).tobytes()
                d.PixelData += b"\0" * (len(d.PixelData) % 2)
                d["PixelData"].VR = "OB" if kind == "u1" else "OW"
                d.save_as(f"dicom_{kind}/{t}{k}.dcm", enforce_file_format=True)
        for t in range(2):
            check("pydicom, times", f"dicom_{kind}", a[..., t], "--time", str(t),
                  steps=[[-0.75, 0, 0], [0, -1.25, 0], [0, 0, 2.5]], origin=[-31.5, 12.25, 0])


    pydicom_jpeg_2000(pydicom_module, d)

    # One of eight slices is missing.
    a = np.asfortranarray(np.random.default_rng(3).integers(0, 4000, (7, 5, 8)).astype("i2"))
    d = pydicom_module.dcmread("dicom_i2/00.dcm")
    os.makedirs("gap", exist_ok=True)
    for k in (0, 1, 2, 4, 5, 6, 7):
        d.file_meta.MediaStorageSOPInstanceUID = d.SOPInstanceUID = generate_uid()
        d.InstanceNumber, d.ImagePositionPatient = k + 1, [31.5, -12.25, 2.5 * k]
        d.PixelData = np.ascontiguousarray(a[:, :, k].T).tobytes()
        d.save_as(f"gap/{k}.dcm", enforce_file_format=True)
    want = a.astype("f4")
    want[:, :, 3] = np.nan
    check("pydicom, a gap", "gap", want, steps=[[-0.75, 0, 0], [0, -1.25, 0], [0, 0, 2.5]],
          origin=[-31.5, 12.25, 0])
    colours = pydicom_module.data.get_testdata_file("SC_rgb_jpeg.dcm")
    refuse("pydicom, colours", colours, "a picture in colours (`RGB`)")


def pydicom_jpeg_2000(pydicom_module, d):
    """Series that OpenJPEG encodes by way of pydicom, and pydicom's own files: each to the bit, with loss
    within 4, of 65,536 at most."""
    from pydicom.pixels import pixel_array
    from pydicom.uid import ExplicitVRLittleEndian, JPEG2000, JPEG2000Lossless, generate_uid
    shape = (45, 37, 3)
    for bits in (8, 10, 12, 16):
        for signed in (0, 1):
            low = -(1 << bits - 1) if signed else 0
            kind = "iu"[1 - signed] + ("1" if bits == 8 else "2")
            a = np.random.default_rng(bits).integers(low, low + (1 << bits), shape)
            a[:, :20] = np.add.outer(np.arange(45), 3 * np.arange(20))[..., None] % (1 << bits) + low
            a = np.asfortranarray(a.astype(kind))
            for how in (JPEG2000Lossless, JPEG2000):
                folder = f"j2k_{bits}_{signed}_{'lossy' if how == JPEG2000 else 'exact'}"
                os.makedirs(folder, exist_ok=True)
                series, want = generate_uid(), a.copy(order="F")
                for k in range(3):
                    s = pydicom_module.Dataset(d)
                    s.preamble, s.file_meta = b"\0" * 128, pydicom_module.dataset.FileMetaDataset(d.file_meta)
                    s.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
                    s.SeriesInstanceUID, s.InstanceNumber = series, k + 1
                    s.SOPInstanceUID = s.file_meta.MediaStorageSOPInstanceUID = generate_uid()
                    s.ImagePositionPatient = [31.5, -12.25, 2.5 * k]
                    s.Rows, s.Columns = shape[1], shape[0]
                    s.BitsStored, s.HighBit, s.PixelRepresentation = bits, bits - 1, signed
                    s.BitsAllocated = 8 * a.dtype.itemsize
                    s.PixelData = np.ascontiguousarray(a[:, :, k].T).tobytes()
                    s.PixelData += b"\0" * (len(s.PixelData) % 2)
                    s["PixelData"].VR = "OW"
                    s.compress(how, generate_instance_uid=False, **({} if how == JPEG2000Lossless else {"j2k_cr": [4]}))
                    s.save_as(f"{folder}/{k}.dcm", enforce_file_format=True)
                    want[:, :, k] = pixel_array(f"{folder}/{k}.dcm").T
                if how == JPEG2000Lossless:
                    check("pydicom, JPEG 2000", folder, want)
                else:
                    near("pydicom, JPEG 2000 with loss", folder, want, 4)
    for name, most in (("JPEG2000.dcm", 2), ("693_J2KI.dcm", 2), ("J2K_pixelrep_mismatch.dcm", 0)):
        path = pydicom_module.data.get_testdata_file(name)
        # Alone: a damaged twin of one lies beside it.
        os.makedirs(f"own_{name}", exist_ok=True)
        shutil.copy(path, f"own_{name}/1.dcm")
        header = pydicom_module.dcmread(path)
        want = pixel_array(path) * float(header.get("RescaleSlope", 1)) + float(header.get("RescaleIntercept", 0))
        near("pydicom's JPEG 2000 files", f"own_{name}", want.T[:, :, None], most)


def vtk():
    v = peer["vtk"]
    from vtk.util.numpy_support import numpy_to_vtk
    for kind in TYPES:
        a = numbers(kind)
        image = v.vtkImageData()
        image.SetDimensions(DIMS)
        image.SetSpacing(0.7, 1.3, 2.9)
        image.SetOrigin(31.5, -12.25, 107.75)
        array = numpy_to_vtk(a.ravel("F"), deep=True)
        array.SetName("values")
        image.GetPointData().SetScalars(array)
        for mode in ("Ascii", "Binary", "Appended"):
            if mode == "Ascii" and np.dtype(kind).kind == "f":
                continue  # its text has fewer digits
            for packed in ("None", "ZLib", "LZ4", "LZMA"):
                w = v.vtkXMLImageDataWriter()
                w.SetFileName("a.vti")
                w.SetInputData(image)
                getattr(w, f"SetDataModeTo{mode}")()
                getattr(w, f"SetCompressorTypeTo{packed}")()
                w.Write()
                check("VTK", "a.vti", a, steps=np.diag((0.7, 1.3, 2.9)),
                      origin=(31.5, -12.25, 107.75))
        other = np.asfortranarray(a[::-1])
        array = numpy_to_vtk(other.ravel("F"), deep=True)
        array.SetName("other")
        image.GetPointData().AddArray(array)
        w = v.vtkXMLImageDataWriter()
        w.SetFileName("two.vti")
        w.SetInputData(image)
        w.Write()
        legacy = v.vtkStructuredPointsWriter()
        legacy.SetFileName("two.vtk")
        legacy.SetInputData(image)
        legacy.SetFileTypeToBinary()
        legacy.Write()
        for name in ("two.vti", "two.vtk"):
            for dataset, want in (("values", a), ("other", other)):
                check("VTK, one of two arrays", name, want, "--dataset", dataset,
                      steps=np.diag((0.7, 1.3, 2.9)), origin=(31.5, -12.25, 107.75))


def h5py():
    """Every type in every layout, index of chunks and filter; equality with what h5py reads back."""
    h5 = peer["h5py"]
    layouts = {
        "contiguous": {}, "chunks": {"chunks": (2, 3, 4)},
        "gzip": {"chunks": (2, 3, 4), "compression": "gzip"},
        "shuffle": {"chunks": (1, 5, 7), "compression": "gzip", "shuffle": True, "fletcher32": True},
        "grows": {"chunks": (1, 2, 3), "maxshape": (None, 5, 7), "compression": "gzip"},
        "grows twice": {"chunks": (2, 2, 3), "maxshape": (None, None, 7)},
        "one chunk": {"chunks": (3, 5, 7), "compression": "gzip"}, "szip": {"chunks": (2, 3, 4), "compression": "szip"},
    }
    for kind in TYPES + ["f2", "b1"]:
        a = numbers("u1") % 2 == 1 if kind == "b1" else numbers("f4" if kind == "f2" else kind)
        a = (a / 100 if kind == "f2" else a).astype(kind)
        want = np.asfortranarray(a.astype({"f2": "f4", "b1": "u1"}.get(kind, kind)))
        stored = np.ascontiguousarray(a.transpose(2, 1, 0))
        for order in "<>":
            for libver in ("earliest", "v108", "v110", "latest"):
                with h5.File("a.h5", "w", libver=libver if libver in ("earliest", "latest") else (libver, libver)) as f:
                    for name, how in layouts.items():
                        if name == "szip" and (kind == "b1" or kind == "f2" or not h5.h5z.filter_avail(4)):
                            continue
                        f.create_dataset(name, data=stored, dtype=stored.dtype.newbyteorder(order), **how)
                    names = list(f)
                for name in names:
                    check("h5py", "a.h5", want, "--dataset", name)
    # Many chunks in every index, gaps of fill values, scale and offset, a block before, dense attributes.
    a = np.random.default_rng(5).integers(-3000, 3000, (61, 43, 37)).astype("i2")
    want = np.asfortranarray(a.transpose(2, 1, 0))
    for libver in ("earliest", "latest"):
        with h5.File("many.h5", "w", libver=libver, userblock_size=512) as f:
            for name, how in {"tree": {}, "grows": {"maxshape": (None, 43, 37)}, "grows twice": {"maxshape": (None,) * 3}}.items():
                d = f.create_dataset(name, data=a, chunks=(3, 4, 5), compression="gzip", shuffle=True, **how)
                for i in range(20):
                    d.attrs[f"a{i}"] = "x" * 50
            f.create_dataset("scaled", data=a, chunks=(8, 8, 8), scaleoffset=0)
            d = f.create_dataset("gaps", shape=a.shape, dtype="i2", chunks=(8, 8, 8), fillvalue=-7)
            d[10:20, 5:30, 8:] = a[10:20, 5:30, 8:]
            gaps = np.asfortranarray(d[...].transpose(2, 1, 0))
            groups = f.create_group("groups")
            for i in range(300):
                groups.create_group(f"g{i}")
            groups["g299"].create_dataset("deep", data=a)
        for name in ("tree", "grows", "grows twice", "scaled", "groups/g299/deep"):
            check("h5py, many chunks", "many.h5", want, "--dataset", name)
        check("h5py, many chunks", "many.h5", gaps, "--dataset", "gaps")
        t = np.stack([a, a + 1, a + 2])
        with h5.File("t.h5", "w", libver=libver) as f:
            d = f.create_dataset("t", data=t, chunks=(1, 8, 8, 8), compression="gzip")
            d.attrs["element_size_um"] = [0.0, 3.0, 2.0, 1.5]
            for i, name in enumerate("tzyx"):
                d.dims[i].label = name
        check("h5py, times", "t.h5", np.asfortranarray(t[2].transpose(2, 1, 0)), "--time", "2",
              steps=np.diag([1.5e-3, 2e-3, 3e-3]), origin=[0, 0, 0])
    minc(h5)


def minc(h5):
    """MINC 2 by h5py, in every order of dimensions; values and places are nibabel's."""
    import itertools
    import nibabel
    rng = np.random.default_rng(6)
    steps, starts = {"x": -1.5, "y": 2.0, "z": 3.25}, {"x": 10.0, "y": -20.0, "z": 5.5}
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for order in itertools.permutations("xyz"):
        for kind in ("u1", "i1", "u2", "i2", "i4", "f4", "f8"):
            for slices in (False, True):
                a = (rng.normal(size=(4, 5, 6)) * 50).clip(0 if kind[0] == "u" else -120, 120).astype(kind)
                # nibabel keeps files open.
                path = f"{''.join(order)}_{kind}_{slices}.mnc"
                with h5.File(path, "w", libver="latest") as f:
                    for i, c in enumerate("xyz"):
                        d = f.create_dataset(f"minc-2.0/dimensions/{c}space", data=0)
                        d.attrs.update({"step": steps[c], "start": starts[c], "direction_cosines": turn[i],
                                        "units": np.bytes_("mm")})
                    g = f.create_group("minc-2.0/image/0")
                    d = g.create_dataset("image", data=a, chunks=(2, 3, 4), compression="gzip")
                    d.attrs["dimorder"] = np.bytes_(",".join(c + "space" for c in order))
                    if kind[0] != "f":
                        d.attrs["valid_range"] = np.array([2.0, 100.0])
                    for name, v in (("image-min", [-3.0, 1.0, 2.0, 4.0]), ("image-max", [7.0, 9.0, 22.0, 40.0])):
                        d = g.create_dataset(name, data=np.array(v) if slices else v[0])
                        d.attrs["dimorder"] = np.bytes_(order[0] + "space" if slices else "")
                image = nibabel.load(path)
                want = image.get_fdata().transpose(2, 1, 0)
                near("MINC 2 as nibabel", path, want, 1e-5)
                info = json.loads(run("info", path, "--json").stdout)
                affine = image.affine[:3, :3].T[::-1]
                row = counts["MINC 2 as nibabel"]
                if not (np.allclose(info["steps"], affine) and np.allclose(info["origin"], image.affine[:3, 3])):
                    row[1] += 1
                    print(f"DIFFERS: MINC {order} {info['steps']} {info['origin']} want {image.affine}")


def netCDF4():
    nc = peer["netCDF4"]
    for kind in TYPES:
        for how in ({}, {"zlib": True, "shuffle": True, "chunksizes": (1, 2, 3, 4)}, {"fletcher32": True}):
            a = numbers(kind, (2,))
            stored = np.ascontiguousarray(a.transpose(3, 2, 1, 0))
            with nc.Dataset("a.nc", "w") as f:
                for name, size in (("time", None), ("depth", 3), ("y", 5), ("x", 7)):
                    f.createDimension(name, size)
                for name, values, unit in (("depth", [9.0, 6.0, 3.0], "m"), ("y", np.arange(5) * 0.5, "m"),
                                           ("x", np.arange(7) * 0.25 + 1, "m"), ("time", [0.0, 1.0], "days since 2000-1-1")):
                    v = f.createVariable(name, "f8", (name,))
                    v[:], v.units = values, unit
                v = f.createVariable("v", kind, ("time", "depth", "y", "x"), fill_value=False, **how)
                v[:] = stored
                p = f.createVariable("packed", "i2", ("depth", "y", "x"), fill_value=-1)
                p.set_auto_maskandscale(False)
                packed = np.arange(105, dtype="i2").reshape(3, 5, 7) - 20
                p[:], p.scale_factor, p.add_offset = packed, 0.25, 100.0
            for t in range(2):
                check("netCDF4", "a.nc", a[..., t], "--dataset", "v", "--time", str(t),
                      steps=[[250, 0, 0], [0, 500, 0], [0, 0, -3000]], origin=[1000, 0, 9000])
            want = np.where(packed == -1, np.nan, packed * 0.25 + 100).astype("f4")
            check("netCDF4, packed", "a.nc", np.asfortranarray(want.transpose(2, 1, 0)), "--dataset", "packed")
    with nc.Dataset("old.nc", "w", format="NETCDF3_CLASSIC") as f:
        f.createDimension("x", 2)
    refuse("netCDF4, NetCDF 3", "old.nc", "is a NetCDF 3 file, which is not read; convert it with nccopy")


def numpy():
    for kind in TYPES + ["f2", "b1"]:
        a = numbers("u1") % 2 == 1 if kind == "b1" else numbers("f4" if kind == "f2" else kind)
        a = (a / 100 if kind == "f2" else a).astype(kind)
        want = np.asfortranarray(a.astype({"f2": "f4", "b1": "u1"}.get(kind, kind)))
        np.save("a.npy", np.ascontiguousarray(a.transpose(2, 1, 0)))
        check("NumPy", "a.npy", want)
        np.savez_compressed("a.npz", ct=np.ascontiguousarray(a.transpose(2, 1, 0)), other=a)
        check("NumPy", "a.npz", want, "--dataset", "ct")
        np.save("flat.npy", a[:, :, 0].T)
        refuse("NumPy, two axes", "flat.npy", "is a 2-D picture of 7 x 5, not a volume")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    SLABCAST = os.path.abspath(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for name in PEERS:
            try:
                peer[name] = importlib.import_module(name)
            except ImportError:
                print(f"left out: {name} is not installed")
                continue
            globals()[name]()
        os.chdir("/")
    print("\n| writer | equal | differ | refused |\n|---|--:|--:|--:|")
    for writer, row in counts.items():
        print(f"| {writer} | {row[0]} | {row[1]} | {row[2]} |")
    sys.exit(any(row[1] for row in counts.values()))
