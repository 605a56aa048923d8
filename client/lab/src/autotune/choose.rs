//! Settings that keep a word: an error that is not passed, a time that is not overrun.
//!
//! A ladder of settings is climbed from fast to near. For an error: until some rungs keep it, and
//! the fastest of these is taken; for a time: until some rungs overrun it, and the nearest of those
//! before is taken. Rungs are measured when they are needed, and [`super::cache`] remembers them.
//!
//! The word is kept with room to spare: views between those that are judged, and pixels between
//! those that are looked at, may be worse. How often it holds is in docs/accuracy.md.

use super::cache::MeasurementCache;
use super::cluster_bed::all_around;
use super::local_bed::{Clock, LocalBed};
use super::setting::{Setting, fraction};
use super::test_bed::{TestBed, stopped};
use super::trial::{Deviation, Trial};
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_scene::path::Orientation;
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use slabcast_session::progress::{self, Progress};
use slabcast_session::quality_target::QualityTarget;
use slabcast_session::request::RenderRequest;
use std::sync::Arc;
use std::time::Instant;

/// What is measured is so much below what is promised, at least.
const ROOM_RMSE: f64 = 1.2;
/// The same of the error that 99.9 % of the pixels keep: of 3072 pixels a third is not blank, and
/// the second worst of those is all that tells.
const ROOM_MOST: f64 = 1.5;
/// The same of time: a few frames stand for all, and one run of a machine is not like the next.
const ROOM_TIME: f64 = 1.1;
/// Rungs beyond the first that keeps an error, of which one may be faster.
const BEYOND: usize = 3;

/// Returns whether a measured error keeps the target's bounds with room to spare.
fn keeps_error(target: &QualityTarget, off: &Deviation) -> bool {
    let under =
        |bound: Option<f64>, got: f64, room: f64| bound.is_none_or(|b| got * room <= b * 255.0);
    under(target.error, off.rmse, ROOM_RMSE) && under(target.error_max, off.most_999, ROOM_MOST)
}

/// Returns whether a frame time in ms keeps the target's budget with room to spare.
fn keeps_time(target: &QualityTarget, ms: f64) -> bool {
    target.budget.is_none_or(|b| ms * ROOM_TIME <= b)
}

/// What was chosen, and by what.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chosen {
    /// Setting that was chosen.
    pub setting: Setting,
    /// Its measured error.
    pub off: Deviation,
    /// Median of a frame.
    pub ms: f64,
}

/// The rungs, each as fast as the ones before or nearer to the limit.
///
/// From the fronts of `slabcast lab report` (docs/accuracy.md): 16-bit sums with eps falling as sheets
/// become thin, then 32 bits where those round too much. 16 bits are tried only where they have room
/// for a sheet.
pub(super) fn ladder(base: &Setting, size: [u32; 2]) -> Vec<Setting> {
    let b = base.quality;
    let short = b.fits_i16();
    let few = if short { Sums::I16 } else { Sums::Auto };
    let rungs: [(u32, f64, f64, Sums); 16] = [
        (4, 4.0, 1.0 / 16.0, few),
        (4, 2.0, 1.0 / 64.0, few),
        (2, 4.0, 1.0 / 64.0, few),
        (2, 2.0, 1.0 / 64.0, few),
        (2, 1.0, 1.0 / 256.0, few),
        (1, 4.0, 1.0 / 64.0, few),
        (1, 2.0, 1.0 / 64.0, few),
        (1, 2.0, 1.0 / 512.0, few),
        (1, 1.5, 1.0 / 512.0, few),
        (1, 1.0, 1.0 / 512.0, few),
        (1, 0.75, 1.0 / 1024.0, few),
        (1, 0.5, 1.0 / 4096.0, few),
        (1, 1.0, 1.0 / 4096.0, Sums::Auto),
        (1, 0.5, 1.0 / 4096.0, Sums::Auto),
        (1, 0.25, 1.0 / 16384.0, Sums::Auto),
        (1, 0.125, 1.0 / 65536.0, Sums::Auto),
    ];
    let settings = rungs.into_iter().map(|(shrink, thickness, eps, sums)| Setting {
        quality: Quality { thickness, eps, sums, ..b },
        shrink,
        ..*base
    });
    let mut all: Vec<Setting> =
        settings.filter(|s| s.quality.check().is_ok() && s.drawn_size(size).is_some()).collect();
    all.dedup();
    all
}

/// Measures what is not known yet.
struct Climb<'a> {
    place: &'a mut dyn TestBed,
    kept: &'a mut MeasurementCache,
    /// Times of a place that does not keep them.
    times: Vec<(Setting, f64)>,
    progress: Progress,
    measured: usize,
}

impl Climb<'_> {
    fn off(&mut self, setting: &Setting) -> Result<Deviation, Fail> {
        if let Some(off) = self.kept.off(setting) {
            return Ok(off);
        }
        stopped()?;
        let off = self.place.off(setting, &mut self.progress)?;
        self.measured += 1;
        self.kept.put_off(setting, off);
        Ok(off)
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        let keeps = self.place.keeps_times();
        let known = if keeps {
            self.kept.ms(setting)
        } else {
            self.times.iter().find(|(s, _)| s == setting).map(|(_, ms)| *ms)
        };
        if let Some(ms) = known {
            return Ok(ms);
        }
        stopped()?;
        let ms = self.place.ms(setting)?;
        self.measured += 1;
        if keeps {
            self.kept.put_ms(setting, ms);
        } else {
            self.times.push((*setting, ms));
        }
        Ok(ms)
    }

    fn chosen(&mut self, setting: Setting) -> Result<Chosen, Fail> {
        let (off, ms) = (self.off(&setting)?, self.ms(&setting)?);
        Ok(Chosen { setting, off, ms })
    }

    /// The fastest of those that keep an error.
    fn by_error(&mut self, target: &QualityTarget, rungs: &[Setting]) -> Result<Chosen, Fail> {
        let (mut best, mut beyond): (Option<Chosen>, usize) = (None, 0);
        let mut nearest: Option<(f64, f64)> = None;
        for setting in rungs {
            let off = self.off(setting)?;
            let least = nearest.get_or_insert((off.rmse, off.most_999));
            *least = (least.0.min(off.rmse), least.1.min(off.most_999));
            if keeps_error(target, &off) {
                let chosen = self.chosen(*setting)?;
                if best.is_none_or(|b| chosen.ms < b.ms) {
                    best = Some(chosen);
                }
            }
            beyond += usize::from(best.is_some());
            if beyond > BEYOND {
                break;
            }
        }
        let Some(best) = best else {
            let (rmse, most) = nearest.unwrap_or_default();
            let (flag, least) = match (target.error, target.error_max) {
                (Some(e), _) if rmse * ROOM_RMSE > e * 255.0 => ("error", rmse * ROOM_RMSE),
                _ => ("error-max", most * ROOM_MOST),
            };
            return Err(Fail::usage(format!(
                "--{flag}: no setting comes so near in this scene; the nearest may promise \
                 {:.3}/255: give {:.5} or more",
                least,
                least / 255.0 * 1.005
            )));
        };
        if !keeps_time(target, best.ms) {
            return Err(Fail::usage(format!(
                "--budget: the fastest setting that keeps {} takes {:.1} ms ({}); give {:.0}ms or \
                 more, a larger error or a smaller --size",
                QualityTarget { budget: None, ..*target }.flags(),
                best.ms,
                best.setting.name(&self.place.base()),
                (best.ms * ROOM_TIME).ceil()
            )));
        }
        Ok(best)
    }

    /// The nearest of those that keep a time.
    fn by_time(&mut self, target: &QualityTarget, rungs: &[Setting]) -> Result<Chosen, Fail> {
        let (mut within, mut over) = (Vec::new(), 0);
        let mut fastest = f64::INFINITY;
        for setting in rungs {
            let ms = self.ms(setting)?;
            fastest = fastest.min(ms);
            if keeps_time(target, ms) {
                within.push(*setting);
                over = 0;
            } else {
                over += 1;
            }
            // Rungs come in the order of their usual cost, and this scene may be unusual.
            if over > BEYOND {
                break;
            }
        }
        // Finer ones are nearer, but for those whose eps or sums stand out.
        let last = within.len().saturating_sub(BEYOND + 1);
        let mut best: Option<Chosen> = None;
        for setting in within.split_off(last) {
            let chosen = self.chosen(setting)?;
            if best.is_none_or(|b| chosen.off.rmse < b.off.rmse) {
                best = Some(chosen);
            }
        }
        best.ok_or_else(|| {
            Fail::usage(format!(
                "--budget: the fastest setting of this scene takes {fastest:.1} ms on {}; give {:.0}ms \
                 or more, a smaller --size or more threads",
                self.place.crew(),
                (fastest * ROOM_TIME).ceil()
            ))
        })
    }
}

/// Chooses the settings of a scene by what they should come to, and says so.
///
/// # Errors
/// Nothing keeps it: names what would.
pub fn choose(
    place: &mut dyn TestBed,
    target: &QualityTarget,
    quiet: bool,
) -> Result<Chosen, Fail> {
    let began = Instant::now();
    let mut kept = MeasurementCache::of(place.identity());
    let (base, size) = (place.base(), place.size());
    let rungs = ladder(&base, size);
    let known = kept.len();
    let mut progress = Progress::new(quiet).counting("pixel");
    progress.phase("choosing a setting");
    if known == 0 && !quiet {
        progress::note(&format!(
            "{}: this scene is measured first; that is kept for the next time",
            target.flags()
        ));
    }
    let times = Vec::new();
    let mut climb = Climb { place, kept: &mut kept, times, progress, measured: 0 };
    let by_error = target.error.is_some() || target.error_max.is_some();
    let chosen =
        if by_error { climb.by_error(target, &rungs) } else { climb.by_time(target, &rungs) };
    let measured = climb.measured;
    climb.progress.end();
    // What was measured serves also where nothing was found.
    if measured > 0 {
        kept.save();
    }
    let chosen = chosen?;
    if !quiet {
        let how = if measured == 0 {
            "as measured before".to_string()
        } else {
            format!("measured in {}", progress::time(began.elapsed()))
        };
        let q = &chosen.setting.quality;
        let size = match chosen.setting.drawn_size(size) {
            Some([w, h]) if chosen.setting.shrink > 1 => format!(", drawn at {w}x{h}"),
            _ => String::new(),
        };
        progress::note(&format!(
            "{}: thickness {}, eps {}, sums {}{size}{}; RMSE {:.3}/255, 99.9 % within {:.2}/255, {:.1} \
             ms a frame ({how})",
            target.flags(),
            q.thickness,
            fraction(q.eps),
            super::setting::lower(&q.sums),
            if chosen.setting == base { " (the default)" } else { "" },
            chosen.off.rmse,
            chosen.off.most_999,
            chosen.ms,
        ));
    }
    Ok(chosen)
}

impl Chosen {
    /// Puts it into what was asked for.
    pub fn settle(&self, request: &mut RenderRequest) {
        request.target = QualityTarget::default();
        request.quality = self.setting.quality;
        if let Some(size) = self.setting.drawn_size(request.path.size) {
            request.path.size = size;
            request.magnify = self.setting.shrink;
        }
    }
}

/// A scene that is asked for with a target, to be tried out by this process.
pub fn trial(
    volume: &Arc<Volume>,
    info: &VolumeInfo,
    request: &RenderRequest,
    orientation: Orientation,
    threads: usize,
) -> Result<Trial, Fail> {
    let mut around = request.clone();
    around.path = all_around(&request.path);
    Trial::new(volume.clone(), info.clone(), &around, orientation, threads)
}

/// Chooses the quality of what was asked for if it names none but what it should come to, by plain
/// drawing. `volume` fits it.
pub fn settle(
    volume: &Arc<Volume>,
    info: &VolumeInfo,
    request: &mut RenderRequest,
    orientation: Orientation,
    threads: usize,
) -> Result<(), Fail> {
    if request.target.is_empty() {
        return Ok(());
    }
    let trial = trial(volume, info, request, orientation, threads)?;
    let clock = Clock::Plain(Cut { tile: 64, ..Cut::on(threads) });
    choose(&mut LocalBed::new(trial, clock), &request.target.clone(), false)?.settle(request);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::quality::Kernel;

    #[test]
    fn ladder_of_settings_is_valid_and_ordered_from_coarse_to_fine() {
        let base = Setting::asked(Quality::default());
        let all = ladder(&base, [512, 512]);
        assert_eq!(all.len(), 16);
        assert!(all.iter().all(|s| s.quality.check().is_ok()));
        let odd = ladder(&base, [511, 512]);
        assert!(odd.iter().all(|s| s.shrink == 1) && odd.len() == 11);
        let tent = Setting::asked(Quality { kernel: Kernel::Tent, ..Quality::default() });
        assert!(ladder(&tent, [512, 512]).iter().all(|s| s.quality.sums == Sums::Auto));
    }

    #[test]
    fn targets_are_kept_with_room_to_spare() {
        let target = QualityTarget { error: Some(1.0 / 255.0), ..QualityTarget::default() };
        let off = |rmse| Deviation { rmse, ..Deviation::default() };
        assert!(keeps_error(&target, &off(0.8)) && !keeps_error(&target, &off(0.95)));
        let target = QualityTarget { budget: Some(100.0), error_max: Some(2.0 / 255.0), ..target };
        assert!(keeps_time(&target, 90.0) && !keeps_time(&target, 91.5));
        assert_eq!(target.flags(), "--error, --error-max, --budget");
        let most = Deviation { rmse: 0.1, most_999: 1.9, ..Deviation::default() };
        assert!(!keeps_error(&target, &most) && keeps_error(&QualityTarget::default(), &most));
    }
}
