//! A bounded part of the fuzzing in every `cargo test`: the checked-in corpus, seeded changes of it, and seeded bytes.

use std::fs;
use std::path::Path;

use fuzz::MAX_LEN;
use proptest::prelude::*;
use proptest::sample::Index;
use proptest::test_runner::{Config, TestCaseError, TestRunner};

fn corpus(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("corpus")
        .join(name);
    let files = fs::read_dir(&folder).expect("a folder");
    let mut paths: Vec<_> = files.map(|file| file.expect("a file").path()).collect();
    paths.sort();
    let files: Vec<_> = paths
        .iter()
        .map(|path| fs::read(path).expect("a file"))
        .collect();
    assert!(!files.is_empty(), "{}", folder.display());
    files
}

/// A change: what, where, with which byte.
type Change = (u8, Index, u8);

fn changed(mut bytes: Vec<u8>, changes: &[Change], other: &[u8], most: usize) -> Vec<u8> {
    for (what, at, byte) in changes {
        let at = at.index(bytes.len() + 1);
        match what {
            0 if at < bytes.len() => bytes[at] = *byte,
            1 if at < bytes.len() => bytes[at] ^= 1 << (byte % 8),
            2 => bytes.insert(at, *byte),
            3 if at < bytes.len() => drop(bytes.remove(at)),
            // Goes on as another script, or with itself from there.
            4 => bytes.splice(at.., other.iter().copied()).for_each(drop),
            5 => bytes.extend_from_within(at..),
            _ => {}
        }
    }
    bytes.truncate(most);
    bytes
}

/// The corpus, and so many cases of the seed in `.cargo/config.toml`.
fn bounded(name: &str, target: fn(&[u8]), cases: u32) {
    let corpus = corpus(name);
    for bytes in &corpus {
        assert!(bytes.len() <= MAX_LEN, "longer than it is fuzzed");
        target(bytes);
    }
    let config = Config {
        cases,
        failure_persistence: None,
        max_shrink_iters: 2_000,
        ..Config::default()
    };
    let changes = prop::collection::vec((0_u8..6, any::<Index>(), any::<u8>()), 0..8);
    // Small bytes begin steps and are lengths.
    let noise = prop::collection::vec(prop_oneof![0_u8..40, any::<u8>()], 0..MAX_LEN);
    let script = (any::<Index>(), any::<Index>(), changes).prop_map(|(one, other, changes)| {
        let bytes = one.get::<Vec<u8>>(&corpus).clone();
        changed(bytes, &changes, other.get::<Vec<u8>>(&corpus), MAX_LEN)
    });
    let script = prop_oneof![3 => script, 1 => noise];
    let run = |bytes: Vec<u8>| -> Result<(), TestCaseError> {
        target(&bytes);
        Ok(())
    };
    if let Err(found) = TestRunner::new(config).run(&script, run) {
        panic!("{name}: {found}");
    }
}

#[test]
fn bytes_at_the_receiver() {
    bounded("stream", fuzz::stream::target, 10_000);
}

#[test]
fn what_a_device_says() {
    bounded("host", fuzz::host::target, 1_000);
}

#[test]
fn requests_over_http() {
    bounded("http", fuzz::http::target, 300);
}
