//! The program's commands as a user runs them, each in processes of its own.
//!
//! One test program, since several take longer to build, and one after the other to run:
//! `cargo test -p slabcast --test commands front` runs a room of it.

mod after;
mod colour_rule;
mod colour_volumes;
mod colours_and_cameras;
mod config;
mod convergence;
mod error;
mod explain;
mod formats;
mod framing;
mod front;
mod habits;
mod help;
mod manners;
mod plan;
mod program;
mod record;
mod refusals;
mod rehearse;
mod study;
mod takeaway;
mod thin;
