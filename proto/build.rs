//! Compiles the wire with `protox`, so that nobody has to install `protoc`.

use prost::Message;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files = ["slabcast/v1/render.proto", "slabcast/v1/cluster.proto"];
    for file in files {
        println!("cargo::rerun-if-changed={file}");
    }
    let descriptors = protox::compile(files, ["."])?;
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    std::fs::write(out.join("slabcast_descriptor.bin"), descriptors.encode_to_vec())?;
    // `Bytes` everywhere: a received brick or chunk is a part of the buffer it came in, not a
    // copy.
    tonic_prost_build::configure().bytes(".").compile_fds(descriptors)?;
    Ok(())
}
