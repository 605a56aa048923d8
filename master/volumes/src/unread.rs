//! Formats that are not read, recognised by their first bytes or their names, each with the program
//! that converts it.

use crate::error::{FLAT_REMEDY, OpenErrorKind, Problem};
use crate::pictures;

/// Mark by which a format is recognised.
enum Mark {
    /// The file begins with these bytes.
    Begins(&'static [u8]),
    /// These bytes stand at this place.
    At(usize, &'static [u8]),
    /// The file is text and this stands in its first bytes.
    Text(&'static str),
    /// The file's name ends so, in any case.
    Name(&'static str),
}

use Mark::{At, Begins, Name, Text};

const MICROSCOPE: &str =
    "convert it with bioformats2raw (to OME-Zarr), or save it as TIFF with Fiji";
const SAVE_ARRAY: &str = "read it in Python and save one volume with numpy.save('one.npy', array)";
const NETCDF_4: &str = "convert it with nccopy -k nc4 IN OUT.nc";
const GIVE_RAW: &str = "give the file of numbers that it names, with the sizes and the type that it \
                        says as --dims and --type";

/// Marks, what the file is, and the remedy. The first line that fits decides.
const UNREAD: &[(Mark, &str, &str)] = &[
    (Begins(b"\x89PNG"), "is one PNG picture", FLAT_REMEDY),
    (Begins(b"\xff\xd8\xff"), "is one JPEG picture", FLAT_REMEDY),
    (Begins(b"GIF8"), "is a GIF picture", "save its frames as PNG files in one folder"),
    (Begins(b"BM"), "is a BMP picture", "save the stack as PNG or TIFF, and give its folder"),
    (Begins(b"\x76\x2f\x31\x01"), "is an OpenEXR picture", "save the stack as TIFF of float32"),
    (
        Begins(b"MATLAB 5.0"),
        "is a MATLAB file",
        "read it with scipy.io.loadmat and save one volume with numpy.save",
    ),
    (Name(".mnc"), "is a MINC 1 file", "convert it with mincconvert -2, or with mnc2nii"),
    (Begins(b"CDF\x01"), "is a NetCDF 3 file", NETCDF_4),
    (Begins(b"CDF\x02"), "is a NetCDF 3 file", NETCDF_4),
    (Begins(b"CDF\x05"), "is a NetCDF 3 file", NETCDF_4),
    (
        Begins(b"\x0e\x03\x13\x01"),
        "is an HDF4 file",
        "convert it to HDF5 with h4toh5, or save one array with numpy.save",
    ),
    (Text("BYTEORDER_STRING"), "is the header of an AFNI volume", "convert it with 3dAFNItoNIFTI"),
    (Name(".brik"), "is the data of an AFNI volume", "convert it with 3dAFNItoNIFTI"),
    (Name(".brik.gz"), "is the data of an AFNI volume", "convert it with 3dAFNItoNIFTI"),
    (
        Text("= DATA DESCRIPTION FILE ="),
        "is the header of a Philips PAR/REC volume",
        "convert it with dcm2niix",
    ),
    (Name(".rec.gz"), "is packed", "unpack it with gunzip"),
    (Begins(b"mrtrix image"), "is an MRtrix image", "convert it with mrconvert IN OUT.nii"),
    (
        Begins(b"SIMPLE  ="),
        "is a FITS file",
        "read it with Python's astropy and save one cube with numpy.save",
    ),
    (Text("ObjectFileName:"), "is the header of a QVis volume", GIVE_RAW),
    (Text("DATA_FILE:"), "is the header of a brick of values (BOV)", GIVE_RAW),
    (Begins(b"ENVI"), "is the header of an ENVI image", GIVE_RAW),
    (
        Begins(b"!INTERFILE"),
        "is the header of an Interfile volume",
        "convert it with medcon -c nifti",
    ),
    (
        Text("{volume1}"),
        "is the header of a VGStudio volume",
        "give its .vol with --dims and --type",
    ),
    (Begins(b"PVM"), "is a PVM volume", "unpack it with pvm2raw, and give --dims and --type"),
    (
        Begins(b"DDS v3"),
        "is a packed PVM volume",
        "unpack it with pvm2raw, and give --dims and --type",
    ),
    (Begins(b"DDS "), "is a texture (DDS)", "save its layers as PNG files in one folder"),
    (Begins(b"\xabKTX"), "is a texture (KTX)", "save its layers as PNG files in one folder"),
    (Begins(b"11111"), "is an SLC volume", "save it as .vti with VTK (vtkSLCReader)"),
    (
        Begins(b"# AmiraMesh"),
        "is an Amira mesh",
        "save it as NRRD with Amira, or as TIFF with Fiji",
    ),
    (Begins(b"# Avizo"), "is an Avizo mesh", "save it as NRRD with Avizo, or as TIFF with Fiji"),
    (Begins(b"MATRIX7"), "is an ECAT volume", "convert it with medcon -c nifti, or with nibabel"),
    (At(252, b"\xef\xff\xe9\xb0"), "is a GIPL volume", "convert it with c3d IN -o OUT.nii.gz"),
    (At(252, b"\x2a\xe3\x89\xb8"), "is a GIPL volume", "convert it with c3d IN -o OUT.nii.gz"),
    (Begins(b"ZISRAWFILE"), "is a Zeiss microscope file (CZI)", MICROSCOPE),
    (Begins(b"\x70\0\0\0"), "is a Leica microscope file (LIF)", MICROSCOPE),
    (Begins(b"\xda\xce\xbe\x0a"), "is a Nikon microscope file (ND2)", MICROSCOPE),
    (Begins(b"\xd0\xcf\x11\xe0"), "is a microscope file (OIB or ZVI)", MICROSCOPE),
    (Name(".oif"), "is an Olympus microscope file", MICROSCOPE),
    (
        Begins(b"\x20BDV\0\0\0\0"),
        "is an OpenVDB grid (sparse)",
        "fill an array with pyopenvdb (copyToArray) and save it with numpy.save",
    ),
    (
        Begins(b"NanoVDB"),
        "is a NanoVDB grid (sparse)",
        "convert it to OpenVDB, fill an array with pyopenvdb (copyToArray) and save it with numpy.save",
    ),
    (Text("<SpimData"), "is the XML of BigDataViewer", "save it as OME-Zarr or TIFF with Fiji"),
    (Begins(b"ply\n"), "is a mesh (PLY)", "give a volume; a mesh has no samples"),
    (Begins(b"solid "), "is a mesh (STL)", "give a volume; a mesh has no samples"),
    (Begins(b"glTF"), "is a scene (glTF)", "give a volume; a scene has no samples"),
    (Begins(b"%PDF"), "is a PDF", "give the volume itself"),
    (Begins(b"PAR1"), "is a table (Parquet)", SAVE_ARRAY),
    (Begins(b"\x80\x02"), "is a Python pickle (it can run programs)", SAVE_ARRAY),
    (Begins(b"\x80\x03"), "is a Python pickle (it can run programs)", SAVE_ARRAY),
    (Begins(b"\x80\x04\x95"), "is a Python pickle (it can run programs)", SAVE_ARRAY),
    (Begins(b"\x80\x05\x95"), "is a Python pickle (it can run programs)", SAVE_ARRAY),
    (At(257, b"ustar"), "is a tar archive", "unpack it with tar -xf, and give the volume in it"),
    (Begins(b"BZh"), "is packed", "unpack it with bunzip2"),
    (Begins(b"\xfd7zXZ"), "is packed", "unpack it with xz -d"),
    (Begins(b"\x28\xb5\x2f\xfd"), "is packed", "unpack it with zstd -d"),
    (
        Begins(b"7z\xbc\xaf\x27\x1c"),
        "is an archive",
        "unpack it with 7z x, and give the volume in it",
    ),
    (Begins(b"Rar!"), "is an archive", "unpack it with unrar x, and give the volume in it"),
    (Begins(b"PK\x05\x06"), "is an empty zip archive", "get the file again"),
    (Begins(b"OggS"), "is sound or video", "save its frames as PNG files in one folder"),
    (At(4, b"ftyp"), "is a video", "save its frames as PNG files, for instance with ffmpeg"),
    (
        Begins(b"RIFF"),
        "is a video, sound or a WebP picture",
        "save its frames as PNG files in one folder",
    ),
    (
        Name(".df3"),
        "is a DF3 volume of POV-Ray",
        "give --dims and --type, with --skip 6 --byte-order big",
    ),
    (Name(".den"), "is a DEN volume", "give --dims, --type and --skip as its header says"),
    (
        Name(".vol"),
        "is the numbers of a volume",
        "give --dims and --type as its header (.vgi) says",
    ),
    (Name(".pvl.nc"), "is a Drishti volume", "save it as raw numbers with Drishti Import"),
];

/// Bytes in which text is looked for.
const TEXT_BYTES: usize = 4096;

/// Returns the error for a file that is known and not read; `None` for any other. `start` are its
/// first bytes, after decompression if `gzip`.
pub(crate) fn problem(start: &[u8], gzip: bool, name: &str) -> Option<Problem> {
    let (what, remedy) = known(start, name)?;
    if let Some((width, height)) = pictures::size(start).filter(|_| remedy == FLAT_REMEDY) {
        let flat = Problem::flat("content", width.into(), height.into());
        return Some(Problem { kind: OpenErrorKind::NotAVolume, ..flat });
    }
    let what = match gzip {
        true => format!("{what}, inside gzip"),
        false => format!("{what}, which is not read"),
    };
    Some(Problem::new(OpenErrorKind::NotAVolume, "content", what, remedy))
}

/// Returns the description of a file with these first bytes (`is a BMP picture`), and the remedy.
pub(crate) fn known(start: &[u8], name: &str) -> Option<(&'static str, &'static str)> {
    let name = name.to_ascii_lowercase();
    let text = &start[..start.len().min(TEXT_BYTES)];
    // Raw numbers may begin with two or four bytes of anything.
    let raw = crate::is_raw(&name);
    let is = |mark: &Mark| match mark {
        Begins(bytes) | At(_, bytes) if raw && bytes.len() < 5 => false,
        Begins(bytes) => start.starts_with(bytes),
        At(place, bytes) => start.get(*place..).is_some_and(|s| s.starts_with(bytes)),
        Text(word) => !text.contains(&0) && text.windows(word.len()).any(|w| w == word.as_bytes()),
        Name(end) => name.ends_with(end),
    };
    UNREAD.iter().find(|(mark, ..)| is(mark)).map(|(_, what, remedy)| (*what, *remedy))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folder_of_what_is_not_read_says_what_it_holds() {
        for (name, bytes, say) in [
            (
                "a.bmp",
                &b"BM\x36\0"[..],
                "but `a.bmp`, which is a BMP picture; save the stack as PNG",
            ),
            ("attributes.json", b"{}", "is N5, or holds attributes.json of it"),
            ("a.txt", b"words", "holds no slices or pictures; give a file"),
        ] {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join(name), bytes).unwrap();
            let e = crate::open(folder.path()).unwrap_err().to_string();
            assert!(e.contains(say), "{e}");
        }
    }

    #[test]
    fn format_that_is_not_read_is_named_with_the_program_that_converts_it() {
        for (start, name, say) in [
            (&b"CDF\x01"[..], "a.nc", "is a NetCDF 3 file, which is not read; convert it with"),
            (b"CDF\x01", "a.mnc", "is a MINC 1 file, which is not read; convert it with"),
            (b"\ntype = string-attribute\nname = BYTEORDER_STRING", "a.HEAD", "3dAFNItoNIFTI"),
            (b"ObjectFileName: a.raw\nResolution: 4 3 2", "a.dat", "QVis volume"),
            (b"ZISRAWFILE\0", "a.czi", "bioformats2raw"),
            (b"\x89PNG\r\n", "a.png", "is one PNG picture, which is not read; give the folder"),
            (
                b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x01\0\0\0\0\x40",
                "a.png",
                "content: is a 2-D picture of 256 x 64, not a volume; give the folder with all",
            ),
            (
                b"\xff\xd8\xff\xe0\0\x04ab\xff\xc0\0\x0b\x08\0\x05\0\x07\x01",
                "a.jpg",
                "content: is a 2-D picture of 7 x 5, not a volume",
            ),
        ] {
            let problem = problem(start, false, name).unwrap().to_string();
            assert!(problem.contains(say), "{problem}");
        }
        let packed = problem(b"mrtrix image", true, "a.mif.gz").unwrap().to_string();
        assert!(packed.contains("is an MRtrix image, inside gzip; convert it with mrconvert"));
        assert_eq!(problem(&[7; 600], false, "a.raw"), None);
        assert_eq!(problem(b"BM\0\x01", false, "a.raw"), None, "raw numbers may begin so");
    }
}
