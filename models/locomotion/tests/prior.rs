//! The draws: declared, seeded, and selected by the paper's sentences only.

use std::fmt::Write;

use locomotion::model::{Model, SETTINGS, Setting};
use locomotion::prior::{Band, DRAWS, PRIORS, Words, agreeing, agrees, draws, kept};
use locomotion::roller;
use rayon::prelude::*;

#[test]
fn every_prior_is_a_parameter() {
    for prior in PRIORS {
        assert!(prior.low < prior.high && !prior.because.is_empty());
        let setting = Setting::named(prior.key).expect(prior.key);
        assert!(SETTINGS.iter().any(|other| other.key == setting.key));
    }
    for (draw, place) in draws().zip(0..) {
        assert_eq!(draw.index, place);
        let model = draw.apply(&Model::ONE);
        model.check().unwrap();
        for (prior, value) in PRIORS.iter().zip(draw.values) {
            assert!((prior.low..=prior.high).contains(&value), "{prior:?}");
            assert_eq!(Setting::named(prior.key).unwrap().value(&model), value);
        }
    }
}

/// Each parameter fills its range evenly: no tenth of it has a quarter too many or too few draws.
#[test]
fn the_draws_fill_their_ranges() {
    for (place, prior) in PRIORS.iter().enumerate() {
        let mut tenths = [0u32; 10];
        for draw in draws() {
            let value = draw.values[place];
            let part = if prior.logarithmic {
                (value / prior.low).ln() / (prior.high / prior.low).ln()
            } else {
                (value - prior.low) / (prior.high - prior.low)
            };
            tenths[((part * 10.0) as usize).min(9)] += 1;
        }
        assert_eq!(tenths.iter().sum::<u32>(), DRAWS.into());
        assert!(
            tenths.iter().all(|count| (300..=500).contains(count)),
            "{}: {tenths:?}",
            prior.key
        );
    }
}

/// The stored numbers are the draws that the sentences keep. Checks every eighth draw, or all with
/// `RETROGRADE_CAMPAIGN=full`. `BLESS=1` writes the numbers again.
#[test]
fn the_sentences_keep_these_draws() {
    let bless = std::env::var_os("BLESS").is_some();
    let full = bless || std::env::var("RETROGRADE_CAMPAIGN").is_ok_and(|what| what == "full");
    let asked = |index: u16| full || index.is_multiple_of(8);
    let all: Vec<_> = draws().filter(|draw| asked(draw.index)).collect();
    let found = [Words::Rig, Words::Tube].map(|words| -> Vec<u16> {
        all.par_iter()
            .filter(|draw| agrees(words, &draw.apply(&Model::ONE)).unwrap())
            .map(|draw| draw.index)
            .collect()
    });
    if bless {
        let mut text = String::from(
            "//! Numbers of the draws that agree with the paper's words. Written by `BLESS=1 cargo test -p locomotion --test all prior`.\n",
        );
        for (name, doc, list) in [("RIG", "rig", &found[0]), ("TUBE", "tube", &found[1])] {
            write!(
                text,
                "\n/// On the {doc}.\n#[rustfmt::skip]\npub(super) static {name}: [u16; {}] = [\n",
                list.len()
            )
            .unwrap();
            for line in list.chunks(20) {
                let line: Vec<_> = line.iter().map(u16::to_string).collect();
                writeln!(text, "    {},", line.join(", ")).unwrap();
            }
            text.push_str("];\n");
        }
        std::fs::write(
            concat!(env!("CARGO_MANIFEST_DIR"), "/src/prior/kept.rs"),
            text,
        )
        .unwrap();
    }
    for (found, words) in found.iter().zip([Words::Rig, Words::Tube]) {
        let kept = kept(words).iter().copied().filter(|index| asked(*index));
        assert_eq!(*found, kept.collect::<Vec<_>>(), "{words:?}");
    }
}

/// The default body agrees with both sets of words; the older ones do not agree with all of those they were not
/// fitted to.
#[test]
fn which_named_body_agrees_with_which_words() {
    for (model, rig, tube) in [
        (Model::ONE, true, true),
        // At 1 mm a returning roller moves it by a third of an antegrade pass.
        (Model::RIG, false, true),
        (Model::TUBE, false, true),
    ] {
        let agrees = |words| agrees(words, &model).unwrap();
        assert_eq!(
            (agrees(Words::Rig), agrees(Words::Tube)),
            (rig, tube),
            "{}",
            model.name
        );
    }
}

/// The words leave more than a factor of four in the displacement on the rig: a single number is no prediction.
#[test]
fn the_band_on_the_rig_is_wide() {
    let mut values: Vec<f64> = agreeing(Words::Rig)
        .map(|draw| {
            let params = roller::Params {
                step_mm: 0.25,
                ..draw.apply(&Model::ONE).rig().unwrap()
            };
            roller::run(params, 5.05).unwrap()
        })
        .collect();
    let band = Band::of(&mut values).unwrap();
    assert_eq!(band.sets, kept(Words::Rig).len());
    assert!(band.low < 25.0 && band.high > 90.0, "{band:?}");
    assert!((band.low..band.high).contains(&46.3));
}

#[test]
fn a_band_is_made_of_its_values() {
    let mut values: Vec<f64> = (0..=100).rev().map(f64::from).collect();
    let band = Band::of(&mut values).unwrap();
    assert_eq!(
        (band.low, band.median, band.high, band.range, band.sets),
        (5.0, 50.0, 95.0, (0.0, 100.0), 101)
    );
    assert_eq!(Band::of(&mut []), None);
}
