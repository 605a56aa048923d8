//! Compiles the wire with `protox`, so that nobody has to install `protoc`.

use prost::Message;
use std::path::PathBuf;

/// The two packages; what these import is compiled with them.
const FILES: [&str; 2] = ["slabcast/render/v1/render.proto", "slabcast/cluster/v1/cluster.proto"];

/// Fields of repeated messages, on the heap: an empty view takes two bytes on the wire, and a
/// stranger may send two million of them (`MAX_RENDER_MESSAGE`).
const BOXED: [&str; 6] =
    ["PathView.eye", "PathView.target", "PathView.up", "Key.target", "Key.up", "Key.transfer"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed=slabcast");
    let descriptors = protox::compile(FILES, ["."])?;
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    std::fs::write(out.join("slabcast_descriptor.bin"), descriptors.encode_to_vec())?;
    // Messages of either package have checksums: of clients each its own, of workers the stream's.
    for (package, codec) in [
        ("slabcast.render.v1", "crate::checked::CheckedCodec"),
        ("slabcast.cluster.v1", "crate::sealed::LenientCodec"),
    ] {
        // `Bytes` everywhere: a received brick or chunk is a part of the buffer it came in, not a
        // copy.
        let mut configured = tonic_prost_build::configure().bytes(".").codec_path(codec);
        for field in BOXED.iter().filter(|_| package == "slabcast.render.v1") {
            configured = configured.boxed(format!(".slabcast.render.v1.{field}"));
        }
        let mut part = descriptors.clone();
        let others = ["slabcast.render.v1", "slabcast.cluster.v1"].map(Some);
        part.file.retain(|f| {
            f.package.as_deref() == Some(package) || !others.contains(&f.package.as_deref())
        });
        configured.compile_fds(part)?;
    }
    Ok(())
}
