//! The page in a real Chromium, over real masters and workers. Pixels are compared, not words: what the
//! canvas holds at rest is hashed by the browser, and is what `slabcast render` writes.
//!
//! Each story needs Debian's `chromium` and says that it is skipped where there is none.

#[path = "support/chromium.rs"]
mod chromium;
#[path = "support/cut_proxy.rs"]
mod cut_proxy;
#[path = "support/processes.rs"]
mod processes;

use chromium::{Chromium, ENTER, ESCAPE, Page, RIGHT, Screen, TAB};
use cut_proxy::CutProxy;
use processes::{Process, SLABCAST};
use sha2::{Digest, Sha256};
use std::io::BufReader;
use std::path::Path;
use std::process::Command;
use std::sync::{Mutex, MutexGuard};

const VOLUME: &str = "formula:spheres:64";
const DESK: Screen = Screen { size: (760, 420), scale: 1.0, touch: false };
const PHONE: Screen = Screen { size: (360, 740), scale: 1.5, touch: true };
const AZIMUTH: &str = "slabcast.core.state.cam.azimuth";

/// One browser at a time: two would take each other's processors, and their deadlines.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(|e| e.into_inner())
}

/// Starts `slabcast view` of the volume; returns the page's address.
fn view() -> (Process, String) {
    processes::first_line(Path::new("."), &["view", VOLUME])
}

/// Waits for the still of the latest view. Returns the hash of the canvas' pixels, made by the
/// browser's own SHA-256, once it is the one that the master says and the page shows.
fn rest(page: &mut Page) -> String {
    page.until("slabcast.viewer.atRest");
    let hash = page.words(
        "(async c => [...new Uint8Array(await crypto.subtle.digest('SHA-256', \
         c.getContext('2d').getImageData(0, 0, c.width, c.height).data))]\
         .map(b => b.toString(16).padStart(2, '0')).join(''))(slabcast.viewer.still)",
    );
    assert_eq!(page.words("slabcast.core.done.sha256"), hash, "the master's word of the pixels");
    let strip = page.words("document.querySelector('[data-part=hash]').textContent");
    assert_eq!(strip, format!("{} = file", &hash[..8]), "the corner");
    hash
}

/// Opens a panel.
fn open_panel(page: &mut Page, name: &str) {
    let tab = format!("#tab-{name}");
    if page
        .ask(&format!("document.querySelector('{tab}').getAttribute('aria-selected') === 'true'"))
        != true
    {
        let at = page.place(&tab, (0.0, 0.0));
        page.click(at);
    }
    page.until(&format!("!document.querySelector('#panel-{name}').hidden"));
}

/// Runs the command that the page gives for its picture, as a user who pastes it, and returns the
/// hash of the pixels that it wrote.
fn pasted(page: &mut Page) -> String {
    open_panel(page, "save");
    let words = page.words("document.querySelector('#panel-save pre').textContent");
    let folder = tempfile::tempdir().expect("a folder");
    let programs = Path::new(SLABCAST).parent().expect("a folder").display();
    let path = format!("{programs}:{}", std::env::var("PATH").expect("PATH"));
    let out = Command::new("sh")
        .args(["-e", "-c", &words])
        .current_dir(folder.path())
        .env("PATH", path)
        .output()
        .expect("sh is there");
    assert!(out.status.success(), "{words}\n{}", String::from_utf8_lossy(&out.stderr));
    let file = std::fs::File::open(folder.path().join("picture.png")).expect("the picture");
    let mut reader = png::Decoder::new(BufReader::new(file)).read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
    let frame = reader.next_frame(&mut pixels).expect("a picture");
    let samples = frame.color_type.samples();
    let mut hash = Sha256::new();
    for pixel in pixels[..frame.buffer_size()].chunks(samples) {
        hash.update(&pixel[..3]);
        hash.update([pixel.get(3).copied().unwrap_or(255)]);
    }
    hash.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

/// Turns by the mouse, and says that the camera did.
fn turn(page: &mut Page, by: (f64, f64)) {
    let before = page.number(AZIMUTH);
    let middle = page.place("#stage", (0.0, 0.0));
    page.drag(middle, by);
    page.until(&format!("{AZIMUTH} !== {before}"));
}

#[test]
fn turned_coloured_and_cut_the_page_shows_the_bytes_of_its_command() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (_view, url) = view();
    let mut page = chromium.open(&url, DESK);
    let first = rest(&mut page);
    assert_eq!(page.ask("document.querySelector('#undo').disabled"), true, "nothing was done yet");
    assert_eq!(pasted(&mut page), first, "first picture");

    turn(&mut page, (90.0, 30.0));
    let turned = rest(&mut page);
    assert_ne!(turned, first);
    assert_eq!(pasted(&mut page), turned, "turned");

    open_panel(&mut page, "colour");
    let points = "slabcast.core.state.tf.opacities.length";
    let before = page.number(points);
    let at = page.place(".tf-view", (0.1, 0.0));
    page.drag(at, (15.0, 20.0));
    assert_eq!(page.number(points), before + 1.0, "a press on the curve adds a point");
    let coloured = rest(&mut page);
    assert_ne!(coloured, turned);
    assert_eq!(pasted(&mut page), coloured, "coloured");

    open_panel(&mut page, "cut");
    page.ask("[...document.querySelectorAll('#panel-cut button')].find(b => b.textContent === 'Half of y off').click()");
    page.until("slabcast.core.state.crop.flat().some(x => x !== null)");
    let cut = rest(&mut page);
    assert_ne!(cut, coloured);
    assert_eq!(pasted(&mut page), cut, "cut open");

    // The address holds it all; a reload and another browser see the same.
    page.until("slabcast.core.address().then(a => a === location.hash)");
    let address = page.words("location.href");
    page.call("Page.reload", serde_json::json!({}));
    page.until("performance.getEntriesByType('navigation')[0].type === 'reload'");
    assert_eq!(rest(&mut page), cut, "reloaded");
    let mut other = chromium.open(&address, DESK);
    assert_eq!(rest(&mut other), cut, "opened elsewhere");

    // Steps back, to the view before the cut.
    open_panel(&mut other, "save");
    page.ask("document.querySelector('#stage').focus()");
    turn(&mut page, (-40.0, 0.0));
    rest(&mut page);
    page.write("z");
    assert_eq!(rest(&mut page), cut, "undone");

    // Two viewers: one turns, the other keeps its view.
    let camera = "JSON.stringify(slabcast.core.state.cam)";
    let kept = other.words(camera);
    turn(&mut page, (60.0, 0.0));
    assert_ne!(rest(&mut page), cut);
    assert_eq!(other.words(camera), kept);
    assert_eq!(rest(&mut other), cut, "the other viewer's picture");
    page.end();
    other.end();
}

#[test]
fn an_address_of_view_at_a_master_opens_volume_and_colours() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    let run = |words: &[&str]| {
        let out = processes::slabcast(dir, words).output().expect("the program runs");
        assert!(out.status.success(), "{words:?}: {}", String::from_utf8_lossy(&out.stderr));
        String::from_utf8(out.stdout).expect("text")
    };
    std::fs::create_dir(dir.join("scans")).expect("a folder");
    for (formula, file) in [("formula:blob:40", "a.nrrd"), ("formula:spheres:40", "knee & co.nrrd")]
    {
        run(&["convert", formula, &format!("scans/{file}"), "-q"]);
    }
    let (_master, address) = processes::master_with(dir, "127.0.0.1:0", &["--volumes", "scans"]);
    let _worker = processes::worker(dir, &address, "one", &[]);
    let view = |words: &[&str]| {
        let url = run(&[&["view"], words, &["--master", &address]].concat());
        url.trim().to_string()
    };
    let volume = "slabcast.core.volume.name";
    let preset = "String(slabcast.core.state.preset)";
    let mut page = chromium.open(&view(&["knee & co.nrrd", "--tf", "bone"]), DESK);
    let bone = rest(&mut page);
    assert_eq!((page.words(volume), page.words(preset)), ("knee & co.nrrd".into(), "bone".into()));
    page.end();
    // The ending of a name may be left out, by hand too.
    let mut page = chromium.open(&format!("http://{address}/#volume=knee%20%26%20co"), DESK);
    let auto = rest(&mut page);
    assert_eq!((page.words(volume), page.words(preset)), ("knee & co.nrrd".into(), "auto".into()));
    assert_ne!(auto, bone);
    assert_eq!(page.words("document.querySelector('#notes').textContent"), "");
    page.end();
    let tf = run(&["tf", "bone", "scans/knee & co.nrrd"]).replace("0.", "0.0");
    std::fs::write(dir.join("own.json"), tf).expect("a file");
    let mut page = chromium.open(&view(&["knee & co", "--tf", "own.json"]), DESK);
    let own = rest(&mut page);
    assert_eq!((page.words(volume), page.words(preset)), ("knee & co.nrrd".into(), "null".into()));
    assert!(own != bone && own != auto, "colours of its own");
    page.end();
    // Without a volume its first is shown, in the colours that are asked for.
    let mut page = chromium.open(&view(&["--tf", "bone"]), DESK);
    rest(&mut page);
    assert_eq!((page.words(volume), page.words(preset)), ("a.nrrd".into(), "bone".into()));
    page.end();
}

#[test]
fn a_lost_connection_and_a_new_master_find_the_view_again() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (first_master, address) = processes::master(Path::new("."), VOLUME, &[]);
    let first_worker = processes::worker(Path::new("."), &address, "first", &[]);
    let proxy = CutProxy::new(&address);
    let mut page = chromium.open(&format!("http://{}/", proxy.address), DESK);
    rest(&mut page);
    turn(&mut page, (70.0, 20.0));
    let turned = rest(&mut page);

    let link = "document.body.dataset.link";
    proxy.cut();
    page.until(&format!("{link} !== 'live'"));
    page.until("document.querySelector('#strip').dataset.state === 'stale'");
    turn(&mut page, (-30.0, 0.0));
    proxy.join();
    page.until(&format!("{link} === 'live'"));
    let while_away = rest(&mut page);
    assert_ne!(while_away, turned, "what a hand did meanwhile counts");
    assert_eq!(pasted(&mut page), while_away);

    drop((first_master, first_worker));
    page.until(&format!("{link} !== 'live'"));
    let (_master, _) = processes::master_with(Path::new("."), &address, &["--volume", VOLUME]);
    let _worker = processes::worker(Path::new("."), &address, "second", &[]);
    page.until(&format!("{link} === 'live'"));
    assert_eq!(rest(&mut page), while_away, "from a master that knew nothing of it");
    page.end();
}

#[test]
fn a_worker_killed_while_the_picture_turns_costs_no_pixel() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (_master, address) = processes::master(Path::new("."), VOLUME, &[]);
    let lost = processes::worker(Path::new("."), &address, "lost", &["--threads", "1"]);
    let _kept = processes::worker(Path::new("."), &address, "kept", &["--threads", "1"]);
    let mut page = chromium.open(&format!("http://{address}/"), DESK);
    rest(&mut page);
    // Both draw: what one holds must be drawn anew by the other.
    turn(&mut page, (40.0, 0.0));
    page.until("slabcast.viewer.atRest && slabcast.core.done.workers === 2");
    let (x, y) = page.place("#stage", (0.0, 0.0));
    page.mouse("mousePressed", (x, y), true);
    for i in 1..=30 {
        page.mouse("mouseMoved", (x + 4.0 * f64::from(i), y), true);
        if i == 10 {
            // It holds what it was lent, and answers nothing: a killed process would be missed sooner.
            lost.signal("-STOP");
        }
        if i == 20 {
            lost.signal("-KILL");
        }
        std::thread::sleep(std::time::Duration::from_millis(16));
    }
    page.mouse("mouseReleased", (x + 120.0, y), true);
    let turned = rest(&mut page);
    assert_eq!(page.number("slabcast.core.done.workers"), 1.0, "the other drew it all");
    assert_eq!(pasted(&mut page), turned);
    page.end();
}

#[test]
fn after_a_stall_the_last_view_arrives() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (view, url) = view();
    let mut page = chromium.open(&url, DESK);
    let first = rest(&mut page);
    view.signal("-STOP");
    turn(&mut page, (90.0, 0.0));
    turn(&mut page, (-30.0, 40.0));
    page.until("document.querySelector('[data-part=state]').textContent === 'drawing'");
    assert_eq!(page.ask("slabcast.viewer.atRest"), false, "nobody draws");
    view.signal("-CONT");
    let turned = rest(&mut page);
    assert_ne!(turned, first);
    assert_eq!(pasted(&mut page), turned);
    page.end();
}

#[test]
fn a_phone_turns_with_one_finger_and_zooms_with_two() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (_view, url) = view();
    let mut page = chromium.open(&url, PHONE);
    let first = rest(&mut page);
    assert_eq!(
        page.ask("document.documentElement.scrollWidth <= innerWidth"),
        true,
        "nothing beyond the edge"
    );
    assert_eq!(page.number("slabcast.core.size[0]"), 540.0, "as many pixels as the screen has");
    let (x, y) = page.place("#stage", (0.0, 0.0));
    let height = "slabcast.core.state.cam.height";
    let (azimuth, before) = (page.number(AZIMUTH), page.number(height));
    page.touch("touchStart", &[(x, y)]);
    for i in 1..=8 {
        page.touch("touchMove", &[(x + 8.0 * f64::from(i), y)]);
    }
    page.touch("touchEnd", &[]);
    page.until(&format!("{AZIMUTH} !== {azimuth}"));
    assert_eq!(page.number(height), before, "one finger does not zoom");
    let turned = rest(&mut page);
    assert_ne!(turned, first);
    page.touch("touchStart", &[(x - 30.0, y), (x + 30.0, y)]);
    for i in 1..=8 {
        let by = 30.0 + 6.0 * f64::from(i);
        page.touch("touchMove", &[(x - by, y), (x + by, y)]);
    }
    page.touch("touchEnd", &[]);
    page.until(&format!("{height} < {before} / 2"));
    let zoomed = rest(&mut page);
    assert_ne!(zoomed, turned);
    // A panel opens below the picture, which shrinks and is drawn anew.
    let tab = page.place("#tab-save", (0.0, 0.0));
    page.touch("touchStart", &[tab]);
    page.touch("touchEnd", &[]);
    page.until("!document.querySelector('#panel-save').hidden && slabcast.core.size[1] < 700");
    let shrunk = rest(&mut page);
    assert_eq!(pasted(&mut page), shrunk);
    page.end();
}

#[test]
fn keys_alone_turn_and_colour() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (_view, url) = view();
    let mut page = chromium.open(&url, DESK);
    let first = rest(&mut page);
    // The first stop leads past everything to the picture.
    page.key(TAB);
    page.key(ENTER);
    page.until("document.activeElement.id === 'stage'");
    let azimuth = page.number(AZIMUTH);
    page.key(RIGHT);
    page.key(RIGHT);
    assert_eq!((page.number(AZIMUTH) - azimuth).abs(), 10.0);
    let turned = rest(&mut page);
    assert_ne!(turned, first);
    // Tab by tab to the table of points, which opens by Enter, and to an opacity in it.
    reach(&mut page, "document.activeElement.textContent === 'All points as a table'");
    page.key(ENTER);
    reach(&mut page, "document.activeElement.ariaLabel === 'Opacity of point 2'");
    page.ask("document.activeElement.select()");
    page.write("0.5");
    page.key(ENTER);
    page.until("slabcast.core.state.tf.opacities[1][1] === 0.5");
    let coloured = rest(&mut page);
    assert_ne!(coloured, turned);
    assert_eq!(pasted(&mut page), coloured);
    page.end();
}

#[test]
fn each_drag_is_a_step_and_escape_closes_what_is_open() {
    let _alone = alone();
    let Some(chromium) = Chromium::start() else { return };
    let (_view, url) = view();
    let mut page = chromium.open(&url, DESK);
    let first = rest(&mut page);
    let steps = "slabcast.core.steps.past.length";
    turn(&mut page, (30.0, 0.0));
    turn(&mut page, (30.0, 0.0));
    assert_eq!(page.number(steps), 3.0, "two drags, however soon the second follows");
    page.write("11");
    page.until("slabcast.core.state.cam.azimuth === 0");
    assert_eq!(page.number(steps), 4.0, "the same side again changes nothing");
    page.write("zzz");
    assert_eq!(rest(&mut page), first, "taken back");

    // A drag on empty ground puts a point and moves it, in one step.
    let points = "slabcast.core.state.tf.opacities.length";
    let before = page.number(points);
    let at = page.place(".tf-view", (0.1, 0.0));
    page.drag(at, (15.0, 20.0));
    assert_eq!((page.number(points), page.number(steps)), (before + 1.0, 2.0));

    // Values behind a pixel lie over the picture, so they close first.
    rest(&mut page);
    page.ask("document.querySelector('#stage').focus()");
    page.write("i");
    page.until("!document.querySelector('#picked').hidden");
    page.key(ESCAPE);
    assert_eq!(page.ask("document.querySelector('#picked').hidden"), true);
    assert_eq!(page.ask("document.querySelector('#panel').hidden"), false, "one at a time");
    page.key(ESCAPE);
    assert_eq!(page.ask("document.querySelector('#panel').hidden"), true);
    page.end();
}

/// Presses Tab until an expression holds, at most a hundred times.
fn reach(page: &mut Page, js: &str) {
    for _ in 0..100 {
        page.key(TAB);
        if page.ask(js) == true {
            return;
        }
    }
    panic!("a hundred Tabs do not lead to {js}");
}
