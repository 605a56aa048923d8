//! Chooses the setting that meets a target: a largest error, a longest frame time, or both.
//!
//! A ladder of settings is climbed from fast to exact. For a largest error, until some rungs meet
//! it; the fastest of these is taken. For a longest time, until some rungs exceed it; the most
//! exact of those before is taken. Rungs are measured when needed, and `cache` keeps the results.
//!
//! Targets are met with a margin, since the views and pixels between the judged ones may be worse.
//! docs/measurements/accuracy.md says how often a target holds.

use super::cache::MeasurementCache;
use super::cluster_bed::all_around;
use super::local_bed::{Clock, LocalBed};
use super::setting::{Setting, fraction};
use super::test_bed::{TestBed, check_not_stopped};
use super::trial::{Deviation, Trial};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_scene::path::Orientation;
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::coarsest_level;
use slabcast_session::progress::{self, Progress};
use slabcast_session::quality_target::QualityTarget;
use slabcast_session::request::RenderRequest;
use std::sync::Arc;
use std::time::Instant;

/// Least ratio of the promised RMSE to the measured one.
const RMSE_MARGIN: f64 = 1.2;
/// Least ratio of the promised error of 99.9 % of the pixels to the measured one. About a third of
/// the 3072 pixels are not blank, so the second worst of these decides.
const MAX_ERROR_MARGIN: f64 = 1.5;
/// Least ratio of the budget to the measured frame time. A few frames stand for all, and the runs
/// of one machine differ.
const TIME_MARGIN: f64 = 1.1;
/// Rungs tried beyond the first that meets (or misses) the target; one of them may be better.
const EXTRA_RUNGS: usize = 3;

/// Returns whether a measured error keeps the target's bounds with the margin.
fn keeps_error(target: &QualityTarget, deviation: &Deviation) -> bool {
    let under =
        |bound: Option<f64>, got: f64, margin: f64| bound.is_none_or(|b| got * margin <= b * 255.0);
    under(target.error, deviation.rmse, RMSE_MARGIN)
        && under(target.error_max, deviation.most_999, MAX_ERROR_MARGIN)
}

/// Returns whether a frame time in ms keeps the target's budget with the margin.
fn keeps_time(target: &QualityTarget, ms: f64) -> bool {
    target.budget.is_none_or(|b| ms * TIME_MARGIN <= b)
}

/// The setting that was chosen for a target, with its measured error and time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chosen {
    /// Setting that was chosen.
    pub(crate) setting: Setting,
    /// Measured error of the setting.
    pub(crate) deviation: Deviation,
    /// Median time of a frame, in ms.
    pub(crate) ms: f64,
}

/// Returns the settings to try for pictures of `size` pixels, from fast to exact.
///
/// The ladder follows the Pareto fronts of `slabcast lab report` (docs/measurements/accuracy.md): 16-bit
/// sums with eps falling as sheets become thin, then 32-bit sums where 16 bits round too much. 16 bits
/// are tried only where a sheet fits them.
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

/// Climbs the ladder and measures what the cache lacks.
struct Climb<'a> {
    bed: &'a mut dyn TestBed,
    cache: &'a mut MeasurementCache,
    /// Frame times in ms on a test bed whose times are not kept.
    times: Vec<(Setting, f64)>,
    progress: Progress,
    measured: usize,
}

impl Climb<'_> {
    fn deviation(&mut self, setting: &Setting) -> Result<Deviation, Fail> {
        if let Some(deviation) = self.cache.deviation(setting) {
            return Ok(deviation);
        }
        check_not_stopped()?;
        let deviation = self.bed.deviation(setting, &mut self.progress)?;
        self.measured += 1;
        self.cache.put_deviation(setting, deviation);
        Ok(deviation)
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        let keeps = self.bed.keeps_times();
        let known = if keeps {
            self.cache.ms(setting)
        } else {
            self.times.iter().find(|(s, _)| s == setting).map(|(_, ms)| *ms)
        };
        if let Some(ms) = known {
            return Ok(ms);
        }
        check_not_stopped()?;
        let ms = self.bed.ms(setting)?;
        self.measured += 1;
        if keeps {
            self.cache.put_ms(setting, ms);
        } else {
            self.times.push((*setting, ms));
        }
        Ok(ms)
    }

    fn chosen(&mut self, setting: Setting) -> Result<Chosen, Fail> {
        let (deviation, ms) = (self.deviation(&setting)?, self.ms(&setting)?);
        Ok(Chosen { setting, deviation, ms })
    }

    /// Returns the fastest rung that keeps the target's error.
    fn by_error(&mut self, target: &QualityTarget, rungs: &[Setting]) -> Result<Chosen, Fail> {
        let (mut best, mut beyond): (Option<Chosen>, usize) = (None, 0);
        let mut nearest: Option<(f64, f64)> = None;
        for setting in rungs {
            let deviation = self.deviation(setting)?;
            let least = nearest.get_or_insert((deviation.rmse, deviation.most_999));
            *least = (least.0.min(deviation.rmse), least.1.min(deviation.most_999));
            if keeps_error(target, &deviation) {
                let chosen = self.chosen(*setting)?;
                if best.is_none_or(|b| chosen.ms < b.ms) {
                    best = Some(chosen);
                }
            }
            beyond += usize::from(best.is_some());
            if beyond > EXTRA_RUNGS {
                break;
            }
        }
        let Some(best) = best else {
            let (rmse, most) = nearest.unwrap_or_default();
            let (flag, least) = match (target.error, target.error_max) {
                (Some(e), _) if rmse * RMSE_MARGIN > e * 255.0 => ("error", rmse * RMSE_MARGIN),
                _ => ("error-max", most * MAX_ERROR_MARGIN),
            };
            return Err(Fail::usage(format!(
                "--{flag}: no setting comes so near the truth in this scene; the best can promise \
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
                best.setting.name(&self.bed.base()),
                (best.ms * TIME_MARGIN).ceil()
            )));
        }
        Ok(best)
    }

    /// Returns the most exact rung that keeps the budget.
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
            // Rungs are in the order of their usual cost, which may not be that of this scene.
            if over > EXTRA_RUNGS {
                break;
            }
        }
        // Finer rungs are more exact, except where eps or the sums limit them.
        let last = within.len().saturating_sub(EXTRA_RUNGS + 1);
        let mut best: Option<Chosen> = None;
        for setting in within.split_off(last) {
            let chosen = self.chosen(setting)?;
            if best.is_none_or(|b| chosen.deviation.rmse < b.deviation.rmse) {
                best = Some(chosen);
            }
        }
        best.ok_or_else(|| {
            Fail::usage(format!(
                "--budget: the fastest setting of this scene takes {fastest:.1} ms on {}; give {:.0}ms \
                 or more, a smaller --size or more threads",
                self.bed.description(),
                (fastest * TIME_MARGIN).ceil()
            ))
        })
    }
}

/// Chooses the setting of a scene that meets `target`, and notes it on stderr unless `quiet`.
///
/// # Errors
/// No setting meets the target (the message names one that would), the scene can't be drawn, the
/// job of a cluster fails, or the user stopped it.
pub fn choose(bed: &mut dyn TestBed, target: &QualityTarget, quiet: bool) -> Result<Chosen, Fail> {
    let began = Instant::now();
    let mut cache = MeasurementCache::open(bed.identity());
    let (base, size) = (bed.base(), bed.size());
    let rungs = ladder(&base, size);
    let known = cache.len();
    let mut progress = Progress::new(quiet).counting("pixel");
    progress.phase("choosing a setting");
    if known == 0 && !quiet {
        progress::note(&format!(
            "{}: this scene is measured first; the result is kept for the next time",
            target.flags()
        ));
    }
    let times = Vec::new();
    let mut climb = Climb { bed, cache: &mut cache, times, progress, measured: 0 };
    let by_error = target.error.is_some() || target.error_max.is_some();
    let chosen =
        if by_error { climb.by_error(target, &rungs) } else { climb.by_time(target, &rungs) };
    let measured = climb.measured;
    climb.progress.end();
    // The measurements serve the next run even if no setting met the target.
    if measured > 0 {
        cache.save();
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
            chosen.deviation.rmse,
            chosen.deviation.most_999,
            chosen.ms,
        ));
    }
    Ok(chosen)
}

impl Chosen {
    /// Replaces the target of `request` by the chosen quality, size and magnification.
    pub fn settle(&self, request: &mut RenderRequest) {
        request.target = QualityTarget::default();
        request.quality = self.setting.quality;
        if let Some(size) = self.setting.drawn_size(request.path.size) {
            request.path.size = size;
            request.magnify = self.setting.shrink;
        }
    }
}

/// Returns a trial of the requested scene in this process. A turntable is tried all around, so that
/// the measurements serve every turn of the scene.
///
/// # Errors
/// The request does not fit the volume.
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

/// Chooses the quality of a request that has a target, by plain drawing on `threads` threads;
/// leaves one without a target as it is. The request must fit the volume.
pub(crate) fn settle(
    volume: &Arc<Volume>,
    info: &VolumeInfo,
    request: &mut RenderRequest,
    orientation: Orientation,
    threads: usize,
) -> Result<(), Fail> {
    if request.target.is_empty() {
        return Ok(());
    }
    let coarsest = coarsest_level(volume, info, request, orientation)?;
    let chosen = at_level_that_keeps_target(request, Some(coarsest), |request| {
        let trial = trial(volume, info, request, orientation, threads)?;
        let clock = Clock::Plain(Cut { tile: 64, ..Cut::on(threads) });
        choose(&mut LocalBed::new(trial, clock), &request.target.clone(), false)
    })?;
    chosen.settle(request);
    Ok(())
}

/// Calls `choose` with the request at one level of detail after another, from coarse to fine, until
/// a level keeps the target; returns what `choose` returned there. The request keeps that level.
///
/// Only a request for `--level auto` tries several: from `coarsest`, the level that `auto` means,
/// to level 0. Without `coarsest` (only the master knows it) it tries `auto`, then level 0.
///
/// # Errors
/// `choose` failed at level 0, or failed at another level for a reason that is not the target.
pub fn at_level_that_keeps_target<T>(
    request: &mut RenderRequest,
    coarsest: Option<u32>,
    mut choose: impl FnMut(&mut RenderRequest) -> Result<T, Fail>,
) -> Result<T, Fail> {
    if request.level != LevelChoice::Auto {
        return choose(request);
    }
    let coarse = match coarsest {
        Some(coarsest) => (1..=coarsest).rev().map(LevelChoice::At).collect(),
        None => vec![LevelChoice::Auto],
    };
    for level in coarse {
        request.level = level;
        match choose(request) {
            Err(e) if e.is_usage() => {
                let what = request.target.flags();
                progress::note(&format!(
                    "--level {level} does not keep {what}; trying a finer one"
                ));
            }
            done => return done,
        }
    }
    request.level = LevelChoice::At(0);
    choose(request)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::quality::Kernel;

    #[test]
    fn ladder_of_settings_is_valid_and_ordered_from_coarse_to_fine() {
        let base = Setting::asked(Quality::before());
        let all = ladder(&base, [512, 512]);
        assert_eq!(all.len(), 16);
        assert!(all.iter().all(|s| s.quality.check().is_ok()));
        let odd = ladder(&base, [511, 512]);
        assert!(odd.iter().all(|s| s.shrink == 1) && odd.len() == 11);
        let tent = Setting::asked(Quality { kernel: Kernel::Tent, ..Quality::before() });
        assert!(ladder(&tent, [512, 512]).iter().all(|s| s.quality.sums == Sums::Auto));
    }

    #[test]
    fn targets_are_kept_with_a_margin() {
        let target = QualityTarget { error: Some(1.0 / 255.0), ..QualityTarget::default() };
        let deviation = |rmse| Deviation { rmse, ..Deviation::default() };
        assert!(keeps_error(&target, &deviation(0.8)) && !keeps_error(&target, &deviation(0.95)));
        let target = QualityTarget { budget: Some(100.0), error_max: Some(2.0 / 255.0), ..target };
        assert!(keeps_time(&target, 90.0) && !keeps_time(&target, 91.5));
        assert_eq!(target.flags(), "--error, --error-max, --budget");
        let most = Deviation { rmse: 0.1, most_999: 1.9, ..Deviation::default() };
        assert!(!keeps_error(&target, &most) && keeps_error(&QualityTarget::default(), &most));
    }
}
