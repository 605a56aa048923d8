//! Who is lent which task, and when: leases, work stealing and speculative copies.

pub(crate) mod lend;
pub(crate) mod pace;
pub(crate) mod split_on_lend;
pub(crate) mod steal;
