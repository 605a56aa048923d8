//! Volumes by name and digest: what is found, read, dropped and refused.

use super::*;
use slabcast_common::volume::{Samples, Volume};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Returns a volume of 8 x 8 x 8 bytes; `seed` makes it another.
fn volume(seed: u32) -> Volume {
    Volume::from_fn_u8("v", [8; 3], move |i, j, k| (i * 3 + j * 5 + k * 7 + seed) as u8)
}

fn axes() -> Orientation {
    Orientation::new(None, None).expect("the defaults")
}

/// Reads files whose first byte is the seed of [`volume`]; counts the files read.
fn reader(count: Arc<AtomicUsize>) -> ReadFile {
    Arc::new(move |path, most| {
        count.fetch_add(1, Relaxed);
        let fail = |reason: &str, is_too_large| Unreadable { reason: reason.into(), is_too_large };
        let bytes = std::fs::read(path).map_err(|e| fail(&e.to_string(), false))?;
        let seed = *bytes.first().ok_or_else(|| fail("the file is empty", false))?;
        if most < 512 {
            return Err(fail("larger than the memory for volumes", true));
        }
        Ok((Arc::new(MemorySource::of(volume(seed.into()))), axes()))
    })
}

struct World {
    dir: tempfile::TempDir,
    library: Library,
    reads: Arc<AtomicUsize>,
}

impl World {
    /// Returns a library of the files `a.nrrd`, `b.nrrd` and so on, with memory for `fits` of them.
    fn new(files: &[&str], fits: u64) -> World {
        let dir = tempfile::tempdir().expect("a folder");
        let folder = dir.path().join("volumes");
        std::fs::create_dir(&folder).expect("a folder");
        for (name, seed) in files.iter().zip(1u8..) {
            std::fs::write(folder.join(name), [seed]).expect("a file");
        }
        let reads = Arc::new(AtomicUsize::new(0));
        let library = World::library(dir.path(), fits, reads.clone());
        World { dir, library, reads }
    }

    fn library(dir: &Path, fits: u64, reads: Arc<AtomicUsize>) -> Library {
        let uploads = Some(UploadConfig { folder: dir.join("uploads"), quota_bytes: 4096 });
        Library::new(LibraryConfig {
            given: None,
            folder: Some(dir.join("volumes")),
            uploads,
            memory_bytes: fits * 512,
            read: reader(reads),
        })
        .expect("a library")
    }

    /// Files of uploads, but for the lock.
    fn files(&self) -> usize {
        let files = std::fs::read_dir(self.dir.path().join("uploads")).expect("the folder");
        files.filter(|f| f.as_ref().is_ok_and(|f| f.file_name() != ".lock")).count()
    }

    fn open(&self, name: &str) -> Result<OpenVolume, VolumeError> {
        self.library.open(&VolumeChoice::Name(name.into()), Viewer::own())
    }
}

fn samples(open: &OpenVolume) -> &slabcast_common::volume::Samples {
    &open.source.whole(open.level).expect("it is in memory").samples
}

fn header(name: &str, volume: &Volume) -> VolumeHeader {
    VolumeHeader {
        name: name.into(),
        file_type: "uint8".into(),
        info: volume.info(volume.digest()),
        orientation: axes(),
    }
}

fn stranger() -> Viewer {
    Viewer::at(Some("10.0.0.1".parse().expect("an address")), false)
}

#[test]
fn files_are_read_when_they_are_asked_for_and_once() {
    let world = World::new(&["a.nrrd", "b.nii.gz", "notes.txt", ".hidden.nrrd"], 8);
    let names = || world.library.list(Viewer::own()).into_iter().map(|v| v.name);
    assert_eq!(names().collect::<Vec<_>>(), ["a.nrrd", "b.nii.gz"]);
    assert_eq!(world.reads.load(Relaxed), 0);
    let open = world.open("a.nrrd").expect("it is there");
    assert_eq!(open.served.info.digest, volume(1).digest());
    assert_eq!(open.served.name, "a.nrrd");
    assert!(world.open("a").is_ok(), "without its ending");
    let digest = VolumeChoice::Digest(open.served.info.digest);
    assert!(world.library.open(&digest, Viewer::own()).is_ok());
    assert_eq!(world.reads.load(Relaxed), 1);
    let e = world.open("c.nrrd").err().expect("no such file");
    assert_eq!(e.to_string(), "no volume `c.nrrd` here; there are a.nrrd, b.nii.gz");
}

#[test]
fn volume_that_was_unused_for_longest_makes_place_and_is_read_again() {
    let world = World::new(&["a.nrrd", "b.nrrd", "c.nrrd"], 2);
    let in_memory = || {
        let listed = world.library.list(Viewer::own());
        listed.into_iter().filter(|v| v.in_memory).map(|v| v.name).collect::<Vec<_>>()
    };
    for name in ["a", "b", "a", "c"] {
        world.open(name).expect("it is there");
    }
    assert_eq!(in_memory(), ["a.nrrd", "c.nrrd"]);
    let digest = VolumeChoice::Digest(volume(2).digest());
    let again = world.library.open(&digest, Viewer::own()).expect("its digest is known");
    assert_eq!(*samples(&again), volume(2).samples);
    assert_eq!(in_memory(), ["b.nrrd", "c.nrrd"]);
}

#[test]
fn volume_larger_than_all_memory_is_refused_and_the_others_stay_readable() {
    let world = World::new(&["a.nrrd"], 0);
    assert!(matches!(world.open("a"), Err(VolumeError::NoRoom(_, false))));
    let world = World::new(&["a.nrrd", "b.nrrd"], 1);
    std::fs::write(world.dir.path().join("volumes/b.nrrd"), []).expect("a file");
    let e = world.open("b").err().expect("it is empty");
    assert!(matches!(e, VolumeError::NotReadable(_)), "{e}");
    let listed = world.library.list(Viewer::own());
    assert_eq!(listed[1].problem, "the file is empty");
    assert!(world.open("a").is_ok());
}

/// A job that asks by digest never gets what the file has become.
#[test]
fn file_that_was_replaced_is_another_volume() {
    let world = World::new(&["a.nrrd"], 8);
    let first = world.open("a").expect("it is there").served.info.digest;
    let path = world.dir.path().join("volumes/a.nrrd");
    std::fs::write(&path, [9, 9]).expect("a file");
    let second = world.open("a").expect("it is there");
    assert_eq!(second.served.info.digest, volume(9).digest());
    let e = world.library.open(&VolumeChoice::Digest(first), Viewer::own()).err();
    assert!(matches!(e, Some(VolumeError::NotFound(_))), "{e:?}");
    std::fs::remove_file(path).expect("it is there");
    assert!(matches!(world.open("a"), Err(VolumeError::NotFound(_))));
    assert!(world.library.list(Viewer::own()).is_empty());
}

/// Samples were dropped, and the file changed before they were needed again.
#[test]
fn file_that_changed_while_its_samples_were_dropped_is_not_taken_for_what_it_was() {
    let world = World::new(&["a.nrrd", "b.nrrd"], 1);
    let first = world.open("a").expect("it is there").served.info.digest;
    world.open("b").expect("it is there");
    std::fs::write(world.dir.path().join("volumes/a.nrrd"), [9, 9]).expect("a file");
    let e = world.library.open(&VolumeChoice::Digest(first), Viewer::own()).err();
    assert!(matches!(e, Some(VolumeError::NotFound(_))), "{e:?}");
}

#[cfg(unix)]
#[test]
fn links_out_of_the_folder_are_not_followed() {
    let world = World::new(&["a.nrrd"], 8);
    let outside = world.dir.path().join("secret.nrrd");
    std::fs::write(&outside, [5]).expect("a file");
    std::os::unix::fs::symlink(&outside, world.dir.path().join("volumes/b.nrrd")).expect("a link");
    let e = world.open("b").err().expect("it leads out");
    assert!(e.to_string().contains("is a link out of the folder"), "{e}");
    for name in ["../secret.nrrd", "../secret", "/etc/passwd", ""] {
        assert!(matches!(world.open(name), Err(VolumeError::NotFound(_))), "{name}");
    }
}

#[test]
fn request_without_a_name_means_the_given_volume_or_the_only_one() {
    let choice = VolumeChoice::Default;
    let world = World::new(&["a.nrrd"], 8);
    assert_eq!(world.library.open(&choice, stranger()).expect("one").served.name, "a.nrrd");
    let world = World::new(&["a.nrrd", "b.nrrd"], 8);
    let e = world.library.open(&choice, Viewer::own()).err().expect("two");
    assert!(e.to_string().contains("2 volumes; name one (`slabcast volumes`"), "{e}");
    let given = Library::of(volume(4), axes());
    assert_eq!(
        given.open(&choice, stranger()).expect("given").served.info.digest,
        volume(4).digest()
    );
    let world = World::new(&[], 8);
    let e = world.library.open(&choice, Viewer::own()).err().expect("none");
    assert!(e.to_string().contains("no volume yet; put one there"), "{e}");
}

/// Names may be patients'.
#[test]
fn strangers_see_digests_in_place_of_names() {
    let world = World::new(&["mueller.nrrd", "b.nrrd"], 8);
    assert!(world.library.list(stranger()).is_empty(), "no digest is known yet");
    let digest = world.open("mueller").expect("it is there").served.info.digest;
    let seen = world.library.list(stranger());
    let short = short_name(digest);
    assert_eq!(seen.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), [short.as_str()]);
    let find = |name: &str| world.library.open(&VolumeChoice::Name(name.into()), stranger());
    assert!(find(&short).is_ok());
    for name in ["mueller.nrrd", "mueller", "b"] {
        let e = find(name).err().expect("it must not know that name");
        assert_eq!(e.to_string(), format!("no volume `{name}` here; there are {short}"));
    }
    let host = Viewer::at(Some("10.0.0.1".parse().expect("an address")), true);
    assert_eq!(world.library.list(host).len(), 2, "with --show-names");
}

#[test]
fn uploads_go_on_where_they_were_and_outlive_the_master() {
    let world = World::new(&[], 8);
    let (library, volume) = (&world.library, volume(7));
    let (digest, bytes) = (volume.digest(), volume.samples.le_bytes(0..512));
    let put = |at: usize, end: usize| library.add_chunk(digest, at as u64, &bytes[at..end]);
    assert!(matches!(put(0, 100), Err(VolumeError::NotFound(_))), "it was not begun");
    let begin = || library.begin_upload(header("mine", &volume), None).expect("there is room");
    assert_eq!(begin(), Progress { received_bytes: 0, done: false });
    assert_eq!(put(0, 100).expect("in order").received_bytes, 100);
    assert_eq!(put(0, 100).expect("twice").received_bytes, 100);
    assert_eq!(put(200, 300).expect("too early").received_bytes, 100);
    assert_eq!(put(50, 300).expect("it overlaps").received_bytes, 300);
    assert_eq!(begin(), Progress { received_bytes: 300, done: false });
    assert!(world.open("mine").is_err(), "it is not whole");
    let done = Progress { received_bytes: 512, done: true };
    assert_eq!(put(300, 512).expect("the last"), done);
    assert_eq!((begin(), put(0, 10).expect("it is there")), (done, done));
    assert_eq!(*samples(&world.open("mine").expect("it is there")), volume.samples);

    let World { dir, library, .. } = world;
    drop(library);
    let again = World::library(dir.path(), 8, Arc::default());
    let open = again.open(&VolumeChoice::Digest(digest), Viewer::own()).expect("it stayed");
    assert_eq!((open.served.info.digest, open.served.name.as_str()), (digest, "mine"));
    assert_eq!(open.served.info, volume.info(digest));
}

#[test]
fn upload_with_other_samples_than_announced_leaves_nothing() {
    let world = World::new(&[], 8);
    let (library, volume) = (&world.library, volume(7));
    let digest = volume.digest();
    library.begin_upload(header("mine", &volume), None).expect("there is room");
    let e = library.add_chunk(digest, 0, &[1; 512]).expect_err("they are others");
    assert!(matches!(e, VolumeError::Damaged(_)), "{e}");
    let left = world.files();
    assert_eq!((left, library.list(Viewer::own()).len()), (0, 0));
    let e = library.add_chunk(digest, 0, &[1; 513]).expect_err("it is gone");
    assert!(matches!(e, VolumeError::NotFound(_)), "{e}");
}

#[test]
fn uploads_beyond_the_quota_and_under_names_of_others_are_refused_before_a_byte() {
    let world = World::new(&["a.nrrd"], 8);
    let library = &world.library;
    let e =
        library.begin_upload(header("a.nrrd", &volume(7)), None).expect_err("the name is taken");
    assert!(matches!(e, VolumeError::NameTaken(_)), "{e}");
    for seed in 20..27 {
        let volume = volume(seed);
        let peer = Some(IpAddr::from([10, 0, 0, seed as u8]));
        library.begin_upload(header(&format!("v{seed}"), &volume), peer).expect("there is room");
    }
    let e = library.begin_upload(header("one more", &volume(30)), None).map(drop);
    assert_eq!(e, Ok(()), "512 bytes are left");
    let e = library.begin_upload(header("too much", &volume(31)), None).expect_err("none is left");
    assert!(e.to_string().contains("--upload-quota"), "{e}");
    let large = Volume::from_fn_u8("large", [32; 3], |_, _, _| 0);
    let e = library.begin_upload(header("large", &large), None).expect_err("it never fits");
    assert!(e.to_string().contains("--volume-memory"), "{e}");
    let none = Library::of(volume(1), axes());
    let e = none.begin_upload(header("b", &volume(2)), None).expect_err("it takes none");
    assert!(e.to_string().contains("--uploads FOLDER"), "{e}");
}

#[test]
fn only_uploads_that_no_job_draws_can_be_removed() {
    let world = World::new(&["a.nrrd"], 8);
    let (library, volume) = (&world.library, volume(7));
    library.begin_upload(header("mine", &volume), None).expect("there is room");
    library.add_chunk(volume.digest(), 0, &volume.samples.le_bytes(0..512)).expect("all of it");
    let remove = |name: &str, used: bool| library.remove(name, Viewer::own(), |_| used);
    assert!(matches!(remove("a.nrrd", false), Err(VolumeError::InUse(_))));
    assert!(matches!(remove("mine", true), Err(VolumeError::InUse(_))));
    assert_eq!(remove("mine", false), Ok(()));
    assert!(matches!(remove("mine", false), Err(VolumeError::NotFound(_))));
    assert_eq!(world.files(), 0);
}

#[test]
fn damaged_file_of_an_upload_is_named_and_never_drawn() {
    let world = World::new(&[], 8);
    let (library, volume) = (&world.library, volume(7));
    library.begin_upload(header("mine", &volume), None).expect("there is room");
    library.add_chunk(volume.digest(), 0, &volume.samples.le_bytes(0..512)).expect("all of it");
    let path = world.dir.path().join("uploads").join(format!("{}.volume", volume.digest()));
    let mut bytes = std::fs::read(&path).expect("the file");
    *bytes.last_mut().expect("samples") ^= 1;
    std::fs::write(&path, &bytes).expect("the file");
    let e = world.open("mine").err().expect("it is damaged");
    assert!(e.to_string().contains("is damaged"), "{e}");
    bytes.truncate(bytes.len() - 1);
    std::fs::write(&path, &bytes).expect("the file");
    assert!(world.open("mine").is_err());
    let World { dir, library, .. } = world;
    drop(library);
    let again = World::library(dir.path(), 8, Arc::default());
    assert!(again.list(Viewer::own()).is_empty(), "a file that is cut is not listed");
}

#[test]
fn uploaded_colours_stay_colours_and_a_place_beyond_the_palette_is_refused() {
    use slabcast_common::volume::{ColourValue, Lattice, Palette};
    let colours = (0..200u8).map(|i| [i, 255 - i, i / 2, i]).collect();
    let palette = Palette::sorted(colours, true, ColourValue::Alpha).expect("200 colours");
    let lattice = Lattice::from_spacing([8; 3], [1.0; 3]);
    let of = |places: Vec<u16>| {
        let palette = palette.clone().into();
        Volume::coloured("c", "RGBA uint8", false, lattice, palette, places)
    };
    let volume = of((0..512).map(|i| i % 200).collect()).expect("places in it");
    let world = World::new(&[], 8);
    let digest = volume.digest();
    world.library.begin_upload(header("mine", &volume), None).expect("there is room");
    let bytes = volume.codes().le_bytes(0..512);
    assert_eq!(bytes.len(), 1024);
    world.library.add_chunk(digest, 0, &bytes[..700]).expect("in order");
    let done = world.library.add_chunk(digest, 700, &bytes[700..]).expect("the last");
    assert_eq!(done, Progress { received_bytes: 1024, done: true });
    let World { dir, library, .. } = world;
    drop(library);
    let again = World::library(dir.path(), 8, Arc::default());
    let open = again.open(&VolumeChoice::Digest(digest), Viewer::own()).expect("it stayed");
    let whole = open.source.whole(0).unwrap();
    assert_eq!(whole.summary, volume.summary);
    assert_eq!((whole.codes(), &whole.samples), (volume.codes(), &volume.samples));

    // A stranger's digest may be right, and a place beyond the palette.
    let mut wrong = volume;
    let mut places: Vec<u16> = vec![3; 512];
    places[9] = 200;
    wrong.places = Some(Samples::U16(places));
    let digest = wrong.digest();
    again.begin_upload(header("wrong", &wrong), None).expect("there is room");
    again.add_chunk(digest, 0, &wrong.codes().le_bytes(0..512)).expect("all of it");
    let e = again.open(&VolumeChoice::Digest(digest), Viewer::own()).err().expect("it is wrong");
    assert!(e.to_string().contains("its palette has no colour 200"), "{e}");
}
