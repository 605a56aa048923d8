//! One picture to check, drawn by every renderer there is.
//!
//! Groups of the table build a [`Shot`] from a volume, a transfer function, a quality and a camera,
//! make it a [`PreparedShot`], and ask for what they need: the serial picture, one on threads, the
//! hashes of clusters, the reference.

use super::cluster::{self, Link, TestCluster};
use slabcast_common::image::Picture;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Keep, Quality, Sums, Work};
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::view::View;
use slabcast_common::volume::{Digest32, Volume, VolumeInfo};
use slabcast_render::judge::reference::{FieldReference, Reference, stratified};
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::path::{Crop, Orientation, PathView, ViewPath};
use slabcast_scene::request::PathRequest;
use slabcast_session::direct::{self, Bricks, Cut};
use slabcast_session::embedded::WorkerGroup;
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::SceneBricks;
use slabcast_volumes::BrickStore;
use std::sync::Arc;
use std::time::Duration;

/// Time limit of one picture by a cluster; the longest default case needs a few seconds. A cluster
/// that hangs fails its case, and the check goes on.
const PATIENCE: Duration = Duration::from_secs(600);

/// Resources that cases share.
pub(crate) struct Tools {
    /// Threads to draw and judge with.
    pub(crate) threads: usize,
    /// Runtime of clusters. Cases run on a thread outside it and may block on it.
    pub(crate) runtime: tokio::runtime::Runtime,
}

/// A scene and a view of it.
#[derive(Clone, Debug)]
pub(crate) struct Shot {
    pub(crate) volume: Arc<Volume>,
    pub(crate) transfer: TransferFunction,
    /// `sums` may be `Auto`.
    pub(crate) quality: Quality,
    /// Width and height in pixels.
    pub(crate) size: [u32; 2],
    /// The camera, in world units.
    pub(crate) view: PathView,
    /// Box outside of which nothing is drawn.
    pub(crate) crop: Option<Crop>,
}

/// Returns `quality` with sums of 32 bits or floats where they are automatic: errors judged here
/// are so small that 16 bits would show.
pub(crate) fn with_precise_sums(
    quality: Quality,
    transfer: &TransferFunction,
    info: &VolumeInfo,
) -> Quality {
    let classifier = Classifier::new(transfer, info, quality.compositing);
    match (quality.sums, classifier.choose_sums(&quality, &info.lattice)) {
        (Sums::Auto, Ok(Sums::I16)) => Quality { sums: Sums::I32, ..quality },
        _ => quality,
    }
}

/// A shot with its bricks and tables, ready to be drawn.
#[derive(Clone)]
pub(crate) struct PreparedShot {
    /// With sums resolved.
    pub(crate) spec: SceneSpec,
    pub(crate) view: View,
    pub(crate) bricks: Bricks,
}

impl Shot {
    fn path(&self) -> ViewPath {
        ViewPath { crop: self.crop, ..ViewPath::from_views(self.size, vec![self.view]) }
    }

    /// Returns the request that has a cluster draw the shot.
    pub(crate) fn request(&self, cull: bool, work: Work) -> PathRequest {
        let info = self.volume.info(Digest32::default());
        let quality = Quality { cull, ..with_precise_sums(self.quality, &self.transfer, &info) };
        cluster::request(self.path(), &self.transfer, quality, work)
    }

    /// Prepares the shot for drawing.
    ///
    /// # Errors
    /// If a master would refuse the request, with the master's message.
    pub(crate) fn ready(&self) -> Result<PreparedShot, Fail> {
        let refused = |e: slabcast_common::quality::InvalidField| Fail::failed(e.to_string());
        self.volume.lattice.check().map_err(Fail::failed)?;
        self.quality.check().map_err(refused)?;
        self.transfer.check().map_err(refused)?;
        let info = self.volume.info(self.volume.digest());
        let orientation = Orientation::new(None, None).map_err(refused)?;
        let camera = self.path().camera(0, &info.lattice, orientation).map_err(refused)?;
        let view = View::new(&info.lattice, &camera, self.size, &self.quality).map_err(refused)?;
        let quality = with_precise_sums(self.quality, &self.transfer, &info);
        let needs = BrickNeeds::for_path(&self.path(), &self.transfer, None, &info, &quality)
            .map_err(refused)?;
        let SceneBricks { spec, bricks } =
            SceneBricks::with_requirements(&self.volume, &info, &self.transfer, quality, &needs)?;
        Ok(PreparedShot { spec, view, bricks })
    }

    /// Returns the limit of a shot that is classified after reconstruction at `sample`, linear
    /// premultiplied RGBA. It is computed from all voxels, stored or not.
    ///
    /// # Errors
    /// If a master would refuse the request.
    pub(crate) fn field_limit(
        &self,
        sample: &[[u32; 2]],
        tools: &Tools,
    ) -> Result<Vec<[f64; 4]>, Fail> {
        let PreparedShot { spec, view, .. } = self.ready()?;
        let all = BrickNeeds::default().with_kept(Keep { empty: true, ..Keep::default() });
        let bricks = BrickStore::build(&self.volume, spec.volume.digest, &all);
        let reference = FieldReference::new(&spec, view, &Bricks::from_store(&bricks));
        Ok(direct::map_parallel(sample.len(), tools.threads, |i, _: &mut ()| {
            reference.pixel(sample[i][0], sample[i][1])
        }))
    }

    /// Draws the shot with the serial renderer, on threads in odd tiles and slabs, by an embedded
    /// cluster in small tiles and many slabs, and by a TCP cluster with culling off. Returns the
    /// serial picture and what differs from it; `None` if all hashes are equal.
    pub(crate) fn everywhere(
        &self,
        ready: &PreparedShot,
        tools: &Tools,
    ) -> Result<(Picture, Option<String>), Fail> {
        let picture = ready.serial();
        let want = picture.sha256().to_string();
        let mut differ = Vec::new();
        let threaded = ready.picture(Cut { threads: tools.threads.max(2), tile: 37, slabs: 3 });
        if threaded.sha256().to_string() != want {
            differ.push("threads".to_string());
        }
        let work = |slabs, tile| Work { slabs, tile: Some(tile), ..Work::default() };
        let (three, two) =
            (WorkerGroup { workers: 3, threads: 1 }, WorkerGroup { workers: 2, threads: 2 });
        for (name, tcp, crew, cull, work) in [
            ("embedded cluster", false, three, true, work(7, 16)),
            ("TCP cluster", true, two, false, work(2, 64)),
        ] {
            match tools.runtime.block_on(self.hash(tcp, crew, cull, work)) {
                Ok(hash) if hash == want => {}
                Ok(_) => differ.push(name.into()),
                Err(e) => differ.push(format!("{name} ({})", e.line().unwrap_or("stopped"))),
            }
        }
        let trouble = (!differ.is_empty()).then(|| format!("differ: {}", differ.join(", ")));
        Ok((picture, trouble))
    }

    /// Returns the hash of the frame that a cluster draws.
    pub(crate) async fn hash(
        &self,
        tcp: bool,
        crew: WorkerGroup,
        cull: bool,
        work: Work,
    ) -> Result<String, Fail> {
        let drawn = async {
            let link = if tcp { Link::Tcp } else { Link::Embedded };
            let mut cluster = TestCluster::start(&self.volume, link, crew).await?;
            let hashes = cluster.hashes(self.request(cull, work)).await;
            cluster.end().await;
            hashes?.pop().ok_or_else(|| Fail::failed("no frame came"))
        };
        match tokio::time::timeout(PATIENCE, drawn).await {
            Ok(hash) => hash,
            Err(_) => Err(Fail::failed(format!("no frame within {} s", PATIENCE.as_secs()))),
        }
    }
}

/// The reference that a picture is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReferenceKind {
    /// The limit: the integral along true rays.
    Limit,
    /// Sheets of the same thickness in f64, nothing rounded and nothing shut.
    SameSheets,
}

impl PreparedShot {
    /// Returns the scene and camera with another quality, whose `sums` must not be automatic.
    pub(crate) fn with(&self, quality: Quality) -> PreparedShot {
        let mut other = self.clone();
        other.spec.quality = quality;
        other.view.thickness = quality.thickness;
        other
    }

    /// Returns the frame's tables.
    pub(crate) fn frame(&self) -> Frame {
        Frame::new(Arc::new(Scene::new(&self.spec)), self.view)
    }

    /// Draws the picture with the serial renderer.
    pub(crate) fn serial(&self) -> Picture {
        serial::render(&self.frame(), &self.bricks)
    }

    /// Draws the picture with the tile renderer on threads of this process.
    pub(crate) fn picture(&self, cut: Cut) -> Picture {
        direct::draw(&self.frame(), &self.bricks, cut)
    }

    /// Draws the picture with the tile renderer without shutting any pixel.
    pub(crate) fn never_shut(&self, cut: Cut) -> Picture {
        direct::draw(&self.frame().never_shut(), &self.bricks, cut)
    }

    /// Returns a seeded sample of at most `n` pixels, one from each of about `n` equal cells.
    pub(crate) fn sample(&self, n: usize) -> Vec<[u32; 2]> {
        stratified(self.view.size, n, 1)
    }

    /// Returns the reference at `sample`, linear premultiplied RGBA.
    pub(crate) fn truth(
        &self,
        against: ReferenceKind,
        sample: &[[u32; 2]],
        tools: &Tools,
    ) -> Vec<[f64; 4]> {
        let reference = Reference::new(&self.spec, self.view, &self.bricks);
        direct::map_parallel(sample.len(), tools.threads, |i, _: &mut ()| {
            let [x, y] = sample[i];
            match against {
                ReferenceKind::Limit => reference.pixel(x, y),
                ReferenceKind::SameSheets => reference.at_same_thickness(x, y),
            }
        })
    }

    /// Returns the pixels of `picture` at `sample`.
    pub(crate) fn at(&self, picture: &Picture, sample: &[[u32; 2]]) -> Vec<[f32; 4]> {
        let w = self.view.size[0];
        sample.iter().map(|[x, y]| picture.pixels[(y * w + x) as usize]).collect()
    }
}

/// Returns the largest difference over all four channels, in 1/255; NaN if any channel is.
pub(crate) fn largest(got: &[[f32; 4]], want: &[[f64; 4]]) -> f64 {
    let off = got.iter().flatten().zip(want.iter().flatten());
    off.map(|(&g, &w)| (f64::from(g) - w).abs() * 255.0).fold(0.0, |a: f64, b| {
        // f64::max would forget what is not a number.
        if b.is_nan() || a.is_nan() { f64::NAN } else { a.max(b) }
    })
}

/// Describes the first channel that is not finite or not in 0 to 1, if there is one.
pub(crate) fn sane(picture: &Picture) -> Option<String> {
    first_bad(picture, |p| p.iter().all(|c| (0.0..=1.0 + 1e-6).contains(c)))
}

/// Describes the first such channel, or the first colour that exceeds its opacity by more than
/// `slack`.
pub(crate) fn sane_within(picture: &Picture, slack: f64) -> Option<String> {
    first_bad(picture, |p| {
        let most = f64::from(p[3]) + slack;
        (0.0..=1.0).contains(&p[3]) && p[..3].iter().all(|&c| (0.0..=most).contains(&f64::from(c)))
    })
}

fn first_bad(picture: &Picture, good: impl Fn(&[f32; 4]) -> bool) -> Option<String> {
    let bad = picture.pixels.iter().position(|p| !good(p))?;
    let w = picture.size[0] as usize;
    Some(format!("pixel {},{} is {:?}", bad % w, bad / w, picture.pixels[bad]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nan_is_the_largest_difference() {
        assert_eq!(largest(&[[0.0, 1.0, 0.0, 0.5]], &[[0.0, 0.0, 0.0, 0.5]]), 255.0);
        assert!(largest(&[[f32::NAN; 4], [0.0; 4]], &[[0.0; 4]; 2]).is_nan());
        let picture = |p| Picture { size: [1, 1], pixels: vec![p] };
        assert_eq!(sane_within(&picture([0.0, 0.5, 1.0, 1.0]), 0.0), None);
        for bad in [-0.1, 0.6, f32::INFINITY, f32::NAN] {
            assert!(sane_within(&picture([0.0, bad, 0.0, 0.5]), 0.01).is_some(), "{bad}");
            assert!(sane_within(&picture([0.0, 0.0, 0.0, bad * 2.0]), 0.01).is_some(), "{bad}");
        }
    }
}
