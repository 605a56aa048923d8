use crate::support::simds;
use slabcast_render::selftest::*;

#[test]
fn self_test_hash_is_identical_on_every_instruction_set() {
    for simd in simds() {
        assert_eq!(run(simd).to_string(), slabcast_common::SELF_TEST_SHA256, "{}", simd.name());
    }
}
