use super::*;
use crate::fuzz::gzip;

fn open(header: &str, data: &[u8]) -> Result<Volume, Problem> {
    let bytes = [b"NRRD0004\n", header.as_bytes(), b"\n", data].concat();
    crate::read(Source::from_bytes(bytes), Path::new("."), "test.nrrd", &crate::Hints::default())
}

const RAW: &str = "type: uint8\ndimension: 3\nsizes: 3 2 1\nencoding: raw\n";

#[test]
fn nrrd_accepts_every_spelling_of_the_sample_types() {
    for (names, kind, bytes) in [
        ("signed char,int8,int8_t", "int8", 1),
        ("uchar,unsigned char,uint8,uint8_t", "uint8", 1),
        ("short,short int,signed short,signed short int,int16,int16_t", "int16", 2),
        ("ushort,unsigned short,unsigned short int,uint16,uint16_t", "uint16", 2),
        ("int,signed int,int32,int32_t", "int32", 4),
        ("uint,unsigned int,uint32,uint32_t", "uint32", 4),
        (
            "longlong,long long,long long int,signed long long,signed long long int,int64,\
             int64_t",
            "int64",
            8,
        ),
        ("ulonglong,unsigned long long,unsigned long long int,uint64,uint64_t", "uint64", 8),
        ("float", "float32", 4),
        ("double", "float64", 8),
    ] {
        for name in names.split(',') {
            let header = RAW.replace("uint8", name) + "endian: little\n";
            let data = vec![0; 6 * bytes];
            assert_eq!(open(&header, &data).unwrap().file_type, kind, "{name}");
            let e = open(&header, &data[1..]).unwrap_err().to_string();
            assert!(e.contains("bytes are needed and"), "{name}: {e}");
        }
    }
}

#[test]
fn nrrd_spaces_become_ras() {
    let place = "space directions: (1,0,0) (0,2,0) (0,0.5,3)\nspace origin: (10,20,30)\n";
    for (space, signs, anatomical) in [
        ("right-anterior-superior", [1.0, 1.0, 1.0], true),
        ("RAS", [1.0, 1.0, 1.0], true),
        ("left-anterior-superior", [-1.0, 1.0, 1.0], true),
        ("left-posterior-superior", [-1.0, -1.0, 1.0], true),
        ("LPS", [-1.0, -1.0, 1.0], true),
        ("scanner-xyz", [1.0, 1.0, 1.0], false),
        ("3D-right-handed", [1.0, 1.0, 1.0], false),
        ("3D-left-handed", [1.0, 1.0, -1.0], false),
    ] {
        let v = open(&format!("{RAW}space: {space}\n{place}"), &[0; 6]).unwrap();
        let s = DVec3::from_array(signs);
        assert_eq!(v.lattice.origin, DVec3::new(10.0, 20.0, 30.0) * s, "{space}");
        assert_eq!(v.lattice.steps[2], DVec3::new(0.0, 0.5, 3.0) * s, "{space}");
        assert_eq!(v.anatomical, anatomical, "{space}");
        let zeros = v.lattice.steps.iter().flat_map(|s| s.to_array()).filter(|x| *x == 0.0);
        assert!(zeros.clone().count() > 0 && zeros.into_iter().all(f64::is_sign_positive));
    }
    let bare = open(&format!("{RAW}{place}space dimension: 3\n"), &[0; 6]).unwrap();
    assert!(!bare.anatomical && bare.lattice.steps[1].y == 2.0);
    // A space without directions does not say where the index axes point.
    let lost = open(&format!("{RAW}space: LPS\nspacings: 1 2 3\n"), &[0; 6]).unwrap();
    assert!(!lost.anatomical);
    assert_eq!(lost.lattice.spacing(), [1.0, 2.0, 3.0]);
    let um = "space units: \"um\" \"um\" \"um\"\n";
    let um = open(&format!("{RAW}{place}{um}space: RAS\n"), &[0; 6]).unwrap();
    assert_eq!(um.lattice.origin.x, 0.01);
}

#[test]
fn nrrd_axes_of_colours_vectors_and_time_are_no_axes_of_space() {
    let head = |sizes: &str, more: &str| {
        let n = sizes.split(' ').count();
        format!("type: uint8\ndimension: {n}\nsizes: {sizes}\nencoding: raw\n{more}")
    };
    for kind in [
        "RGB-color",
        "3-color",
        "vector",
        "list",
        "point",
        "time",
        "complex",
        "3-vector",
        "RGBA-color",
        "scalar",
        "normal",
        "covariant-vector",
        "2D-symmetric-matrix",
    ] {
        let e = open(&head("3 2 1", &format!("kinds: {kind} domain domain\n")), &[0; 6]);
        let e = e.unwrap_err().to_string();
        let say =
            format!("kinds (line 6): the first axis of 3 x 2 x 1 is no axis of space: `{kind}`");
        assert!(e.contains(&say) && e.contains("save one of its components"), "{e}");
        // The remedy in the message works.
        assert!(open(&head("3 2 1", "kinds: domain domain domain\n"), &[0; 6]).is_ok());
    }
    for (sizes, more, say) in [
        ("1 3 2", "kinds: scalar space space\n", "no axis of space: `scalar`, 1 sample"),
        ("3 2 1", "space directions: none (1,0,0) (0,1,0)\n", "no axis of space: `none`"),
        ("2 3 2 2", "kinds: vector space space space\n", "a voxel is 2 components (vector)"),
        ("3 2", "", "dimension (line 3): is a 2-D picture of 3 x 2, not a volume; give the folder"),
        ("3 2", "space directions: (1,0) (0,1)\nspace dimension: 2\n", "is a 2-D picture of 3 x 2"),
        ("6", "", "6 samples are a row of one axis"),
    ] {
        let e = open(&head(sizes, more), &[0; 24]).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
}

#[test]
fn nrrd_volume_of_one_time_is_read_from_four_dimensions() {
    let four = RAW.replace("dimension: 3", "dimension: 4").replace("3 2 1", "3 2 1 1");
    let place = "space directions: (-1,0,0,0) (0,-2,0,0) (0,0,3,0) (0,0,0,1)\n\
                 space origin: (4,5,6,0)\n";
    let read = |more: &str| open(&format!("{four}{place}{more}"), &[0; 6]);
    let v = read("space dimension: 4\n").unwrap();
    assert_eq!(v.lattice.dims, [3, 2, 1]);
    assert_eq!(v.lattice.steps, [-DVec3::X, DVec3::Y * -2.0, DVec3::Z * 3.0]);
    assert_eq!((v.lattice.origin, v.anatomical), (DVec3::new(4.0, 5.0, 6.0), false));
    let v = read("space: left-posterior-superior-time\n").unwrap();
    assert_eq!((v.lattice.origin, v.anatomical), (DVec3::new(-4.0, -5.0, 6.0), true));
    assert!(read("space: LPST\n").unwrap().anatomical);
    // Times are no slices, however many there are.
    let times = format!("{four}{place}space dimension: 4\n").replace("3 2 1 1", "3 2 1 2");
    assert_eq!(open(&times, &[0; 12]).unwrap().lattice.dims, [3, 2, 1]);
    let skew = format!("{four}{place}space dimension: 4\n").replace("(0,0,3,0)", "(0,0,3,1)");
    let e = open(&skew, &[0; 6]).unwrap_err().to_string();
    assert!(e.contains("does not say where axis 3 runs in three dimensions"), "{e}");
}

#[test]
fn nrrd_drops_axes_of_one_sample() {
    let data: Vec<u8> = (0..6).collect();
    let want = open(&format!("{RAW}spacings: 1 2 3\n"), &data).unwrap();
    let four = |sizes: &str, rest: &str| {
        let header = RAW.replace("dimension: 3", "dimension: 4").replace("3 2 1", sizes);
        open(&format!("{header}{rest}"), &data)
    };
    for v in [
        four("1 3 2 1", "spacings: nan 1 2 3\nkinds: list domain domain domain\n"),
        four("3 2 1 1", "spacings: 1 2 3 7\n"),
        four("1 3 2 1", "space dimension: 3\nspace directions: none (1,0,0) (0,2,0) (0,0,3)\n"),
    ] {
        let v = v.unwrap();
        assert_eq!((v.lattice, v.samples), (want.lattice, want.samples.clone()));
    }
    let v = four("3 1 1 2", "").unwrap();
    assert_eq!(v.lattice.dims, [3, 1, 2], "the last axis of one sample goes");
    let e = four("3 2 2 4", "").unwrap_err().to_string();
    assert!(e.contains("3 x 2 x 2 x 4 has 4 axes of more than one sample"), "{e}");
}

#[test]
fn nrrd_byte_skip_counts_file_bytes_if_raw_and_decoded_bytes_if_gzip() {
    let data: Vec<u8> = (10..16).collect();
    let want = slabcast_common::volume::Samples::U8(data.clone());
    let junk = [b"one\ntwo\nxyz", &data[..]].concat();
    let skip = "line skip: 2\nbyte skip: 3\n";
    assert_eq!(open(&format!("{RAW}{skip}"), &junk).unwrap().samples, want);
    let v = open(&format!("{RAW}byte skip: -1\n"), &junk).unwrap();
    assert_eq!(v.samples, want);
    let packed = [b"one\ntwo\n".to_vec(), gzip(&[b"xyz", &data[..]].concat())].concat();
    let gz = RAW.replace("raw", "gzip");
    assert_eq!(open(&format!("{gz}{skip}"), &packed).unwrap().samples, want);
    for (skip, say) in [
        ("line skip: 99\n", "line skip: skips past"),
        ("byte skip: 99999999999\n", "byte skip: skips past"),
        ("byte skip: -2\n", "byte skip (line 6): `-2` is below -1"),
        ("line skip: -1\n", "line skip (line 6): `-1` is negative"),
        ("byte skip: x\n", "`x` is not a whole number"),
    ] {
        let e = open(&format!("{RAW}{skip}"), &junk).unwrap_err().to_string();
        assert!(e.contains(say), "{skip}: {e}");
    }
    let e = open(&format!("{gz}byte skip: -1\n"), &packed).unwrap_err().to_string();
    assert!(e.contains("-1 counts from the end"), "{e}");
}

#[test]
fn nrrd_reads_multi_member_gzip_dos_line_ends_and_unknown_fields() {
    let gz = RAW.replace("raw", "gz") + "flavour: odd\nkey:=x: y\n# sizes: 9 9 9\n";
    let members = [gzip(&[1, 2, 3]), gzip(&[4, 5, 6])].concat();
    let v = open(&gz, &members).unwrap();
    assert_eq!(v.samples, slabcast_common::volume::Samples::U8(vec![1, 2, 3, 4, 5, 6]));
    let dos = RAW.replace('\n', "\r\n") + "\r";
    assert!(open(&dos, &[0; 6]).is_ok());
}

#[test]
fn nrrd_encodings_give_the_same_samples() {
    let data = [0, 7, 255, 16, 1, 9];
    let want = slabcast_common::volume::Samples::U8(data.to_vec());
    for (name, bytes) in [
        ("raw", data.to_vec()),
        ("gzip", gzip(&data)),
        ("bz2", crate::fuzz::bzip2(&data)),
        ("bzip2", [crate::fuzz::bzip2(&data[..2]), crate::fuzz::bzip2(&data[2..])].concat()),
        ("ascii", b"0 7\t255\n16, 1 9 \n".to_vec()),
        ("text", b"0 7 255 16 1 9".to_vec()),
        ("hex", b"0007fF 10\n01 09\n".to_vec()),
    ] {
        let v = open(&RAW.replace("raw", name), &bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(v.samples, want, "{name}");
    }
    // The byte order applies to hexadecimal digits, not to decimal text.
    let short = |name: &str| RAW.replace("uint8", "short").replace("raw", name);
    let v = open(&(short("ascii") + "endian: big\n"), b"1 -2 3 4 5 6").unwrap();
    assert_eq!(v.summary.range(), (-2.0, 6.0));
    let v = open(&(short("hex") + "endian: big\n"), b"0001 fffe 0003 0004 0005 0006").unwrap();
    assert_eq!(v.summary.range(), (-2.0, 6.0));
    let double = RAW.replace("uint8", "double").replace("raw", "txt");
    let v = open(&double, b"1e-3 -inf nan 2.5 0 1").unwrap();
    assert_eq!((v.summary.nan, v.summary.infinite, v.summary.range().1), (1, 1, 2.5));
    for (name, bytes, say) in [
        ("ascii", &b"1 2 3 4 5"[..], "6 bytes are needed and 5 are there"),
        ("ascii", b"1 2 3 4 5 6 7", "goes on after the 6 bytes"),
        ("ascii", b"1 2 3 4 5 256", "number 6 is `256`, which is not a value of uint8"),
        ("hex", b"00112233445", "a byte has one hexadecimal digit"),
        ("hex", b"0011223344556677", "goes on after the 6 bytes"),
    ] {
        let e = open(&RAW.replace("raw", name), bytes).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
}

#[test]
fn nrrd_reads_lists_of_data_files_as_one_volume() {
    let dir = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| std::fs::write(dir.path().join(name), bytes).unwrap();
    put("s08.raw", &[0, 1, 2, 3, 4, 5, 99]);
    put("s10.raw", &[6, 7, 8, 9, 10, 11]);
    put("s08.gz", &gzip(&[b'x', 0, 1, 2, 3, 4, 5]));
    put("s10.gz", &gzip(&[b'x', 6, 7, 8, 9, 10, 11]));
    put("long.gz", &gzip(&[b'x', 6, 7, 8, 9, 10, 11, 12]));
    for i in 0..4 {
        put(&format!("row{i}"), &[3 * i, 3 * i + 1, 3 * i + 2]);
    }
    let head = |encoding: &str, more: &str| {
        let head = RAW.replace("3 2 1", "3 2 2").replace("raw", encoding);
        [b"NRRD0004\n", head.as_bytes(), more.as_bytes()].concat()
    };
    let open = |bytes| read(Source::from_bytes(bytes), dir.path(), "v.nhdr");
    for (encoding, files) in [
        ("raw", "data file: LIST\ns08.raw\ns10.raw\n"),
        ("raw", "data file: s%02d.raw 8 10 2\n"),
        ("raw", "data file: s%02d.raw 8 10 2 2\n"),
        ("raw", "data file: row%d 0 3 1 1\n"),
        ("raw", "data file: LIST 1\nrow0\nrow1\nrow2\nrow3\n"),
        ("gzip", "byte skip: 1\ndata file: LIST\ns08.gz\ns10.gz\n"),
    ] {
        let v = open(head(encoding, files)).unwrap_or_else(|e| panic!("{files}: {e}"));
        let want = slabcast_common::volume::Samples::U8((0..12).collect());
        assert_eq!(v.samples, want, "{files}");
    }
    for (encoding, files, say) in [
        ("raw", "data file: LIST\ns08.raw\nnone\n", "data file: `none` is not there"),
        ("raw", "data file: LIST\ns08.raw\nrow1\n", "data file `row1`: truncated: 6 bytes"),
        ("raw", "data file: LIST\ns08.raw\n../x\n", "data file: `../x`"),
        (
            "gzip",
            "byte skip: 1\ndata file: LIST\ns08.gz\nlong.gz\n",
            "data file `long.gz`: goes on after its share of 6 bytes",
        ),
        ("gzip", "byte skip: 1\ndata file: LIST\ns08.gz\nrow1\n", "data file `row1`: "),
    ] {
        let e = open(head(encoding, files)).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
}

#[test]
fn nrrd_errors_name_field_and_remedy() {
    let with = |from: &str, to: &str| RAW.replace(from, to);
    for (header, say) in [
        (with("raw", "zrl"), "encoding (line 5): zrl is not read; save"),
        (with("raw", "bzip2"), "data: the bzip2 stream is damaged after 0 of 6 bytes"),
        (with("raw", "txt"), "data: number 1 is `"),
        (with("raw", "hex"), "is not a hexadecimal digit"),
        (with("raw", "zip"), "`zip` is not an encoding"),
        (with("uint8", "block"), "type (line 2): `block` samples are not numbers"),
        (with("uint8", "char8"), "`char8` is not a type"),
        (with("uint8", "short"), "endian: is missing, and int16 has 2 bytes; add"),
        (with("type: uint8\n", ""), "type: is missing; add a line such as"),
        (with("sizes: 3 2 1\n", ""), "sizes: is missing"),
        (with("3 2 1", "3 2"), "sizes (line 4): `3 2` has 2 entries for 3 axes"),
        (with("3 2 1", "3 2 -1"), "has something else than whole numbers"),
        (with("3 2 1", "3 0 1"), "3 x 0 x 1 has no samples"),
        (with("3 2 1", "3 2 99999"), "is longer than 16384"),
        (with("3 2 1", "16384 16384 16384"), "has more than 68719476736 samples"),
        (with("dimension: 3", "dimension: 2"), "sizes (line 4)"),
        (with("dimension: 3", "dimension: 0"), "`0` is not 1 to 16"),
        (with("type: uint8", "type uint8"), "line 2: `type uint8` is neither"),
        (format!("{RAW}type: uint8\n"), "line 6: `type` was given in line 2 already"),
        (format!("{RAW}spacings: 1 1 0\n"), "spacings (line 6): a spacing is zero"),
        (format!("{RAW}spacings: 1 1 x\n"), "has something else than numbers"),
        (format!("{RAW}space: mars\n"), "`mars` is not a space"),
        (
            format!("{RAW}space: RAST\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"),
            "is not made of vectors",
        ),
        (format!("{RAW}space directions: (1,0,0) (0,1,0)\n"), "has 2 vectors"),
        (format!("{RAW}space directions: (1,0) (0,1) (0,0)\n"), "is not made of vectors"),
        (format!("{RAW}space directions: (1,0,0) (0,1,0) (2,0,0)\n"), "would be flat"),
        (
            format!("{RAW}space directions: (1,0,0) (0,1,0) none\n"),
            "the third axis of 3 x 2 x 1 is no axis of space: `none`",
        ),
        (format!("{RAW}data file: LIST\n"), "names 0 files where the sizes want 1"),
        (format!("{RAW}data file: LIST 2 3\na b\n"), "`LIST 2 3` is not there"),
        (format!("{RAW}data file: LIST 4\na\n"), "ends in no number of axes"),
        (format!("{RAW}data file: LIST\na\nb\n"), "names 2 files where the sizes want 1"),
        (format!("{RAW}data file: a%03d.raw 1 9 1\n"), "names 9 files where the sizes want 1"),
        (format!("{RAW}data file: a%s.raw 1 9 1\n"), "in a way that is not known"),
        (format!("{RAW}data file: no/such.raw\n"), "data file: `no/such.raw` is not there"),
    ] {
        let e = open(&header, &[0; 6]).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
    let bytes = b"NRRD0009\n".to_vec();
    let e = read(Source::from_bytes(bytes), Path::new("."), "t").unwrap_err().to_string();
    assert!(e.contains("line 1: `NRRD0009` is not NRRD0001 to NRRD0005"), "{e}");
    let endless = [b"NRRD0004\n".to_vec(), b"#xxxxxxx\n".repeat(1 << 17)].concat();
    let e = read(Source::from_bytes(endless), Path::new("."), "t").unwrap_err().to_string();
    assert!(e.contains("does not end within 1048576 bytes"), "{e}");
}

#[test]
fn nrrd_takes_one_of_several_volumes_and_one_number_of_a_voxel() {
    let data: Vec<u8> = (0..12).collect();
    let read = |sizes: &str, more: &str, pick: Pick, packed: bool| {
        let mut header = RAW.replace("dimension: 3", "dimension: 4").replace("3 2 1", sizes);
        let mut data = data.clone();
        if packed {
            (header, data) = (header.replace("raw", "gzip"), gzip(&data));
        }
        let bytes = [b"NRRD0004\n", header.as_bytes(), more.as_bytes(), b"\n", &data].concat();
        let source = Source::from_bytes(bytes);
        let notes = source.notes.clone();
        let hints = crate::Hints { pick, ..crate::Hints::default() };
        let v =
            crate::read(source, Path::new("."), "test.nrrd", &hints).map_err(|p| p.to_string())?;
        assert_eq!(v.lattice.dims, [3, 2, 1]);
        let codes: Vec<u8> = (0..6).map(|i| v.samples.code(i) as u8).collect();
        Ok::<_, String>((codes, notes.take().join("; ")))
    };
    let (none, nth) = (Pick::default(), |n| Pick { volume: Some(n), ..Pick::default() });
    let channel = Pick { channel: Some(1), ..Pick::default() };
    let time = Pick { time: Some(1), ..Pick::default() };
    for packed in [false, true] {
        let read = |sizes: &str, more: &str, pick: Pick| read(sizes, more, pick, packed);
        let list = "kinds: domain domain domain list\n";
        let first = "the first of 2 volumes (a list) was read; --volume takes another";
        assert_eq!(read("3 2 1 2", list, none).unwrap(), (vec![0, 1, 2, 3, 4, 5], first.into()));
        let second = (vec![6, 7, 8, 9, 10, 11], String::new());
        assert_eq!(read("3 2 1 2", list, nth(1)).unwrap(), second);
        assert_eq!(read("3 2 1 2", "kinds: space space space time\n", time).unwrap(), second);
        let odd = (vec![1, 3, 5, 7, 9, 11], String::new());
        let colours = "kinds: vector domain domain domain\n";
        assert_eq!(read("2 3 2 1", colours, channel).unwrap(), odd);
        let e = read("2 3 2 1", colours, none).unwrap_err();
        assert!(e.contains("a voxel is 2 components (vector), not one number; take one"), "{e}");
        let e = read("3 2 1 2", list, nth(2)).unwrap_err();
        assert_eq!(e, "--volume: 2 is not there: the file has 2 volumes; give 0 to 1");
    }
}

#[test]
fn nrrd_axis_mins_and_maxs_give_steps_and_place_where_nothing_else_does() {
    let head =
        |more: &str| format!("type: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\n{more}");
    let place = |more: &str| {
        let v = open(&head(more), &[0; 24]).unwrap_or_else(|e| panic!("{more}: {e}"));
        (v.lattice.spacing(), v.lattice.origin.to_array())
    };
    let range = "axis mins: 0 -3 10\naxis maxs: 8 3 11\n";
    assert_eq!(place(range), ([2.0, 2.0, 0.5], [1.0, -2.0, 10.25]));
    let nodes = format!("{range}centerings: node node cell\n");
    assert_eq!(place(&nodes), ([8.0 / 3.0, 3.0, 0.5], [0.0, -3.0, 10.25]));
    // A spacing goes before; what is unknown is 1, and without a place.
    let known = format!("{range}spacings: 1 nan 1\n");
    assert_eq!(place(&known), ([1.0, 2.0, 1.0], [0.5, -2.0, 10.5]));
    assert_eq!(place("axis mins: nan 1 2\n"), ([1.0; 3], [0.0, 1.5, 2.5]));
    let e = open(&head("axis mins: a 1 2\n"), &[0; 24]).unwrap_err().to_string();
    assert!(e.contains("axis mins (line 6): `a 1 2` has something else than numbers"), "{e}");
}
