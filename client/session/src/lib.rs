//! Rendering sessions, shared by the command and its laboratory: a request is rendered by an
//! embedded cluster or by a remote master, and its pictures are written.
//!
//! - [`request`] turns flags and files into a request; [`volume`] opens its volume, [`transfer`]
//!   its colours and opacities, [`parse`] single values.
//! - [`embedded`] renders it by a master and workers in this process, [`remote`] by a cluster
//!   behind a network; both deliver frames through a [`source`]. [`direct`] draws on threads alone,
//!   without master or scheduler, the frames that [`path_scenes`] prepares.
//! - [`output`] writes frames to files or pipes and says in each picture what made it; [`figure`]
//!   draws scale bars, legends and the like over them.
//! - [`progress`], [`terminal`], [`signals`] and [`fail`] are a command's manners: what a person
//!   sees meanwhile, and how it ends.
//!
//! This crate decides nothing about pixels and schedules.

pub mod canvas;
pub mod direct;
pub mod embedded;
pub mod fail;
pub mod figure;
pub mod letters;
pub mod machine;
pub mod magnify;
pub mod output;
pub mod parse;
pub mod path_scenes;
pub mod progress;
pub mod quality_target;
pub mod record;
pub mod remote;
pub mod request;
pub mod runtime;
pub mod signals;
pub mod software;
pub mod source;
pub mod terminal;
#[doc(hidden)]
pub mod testing;
pub mod transfer;
pub mod volume;
