//! A model file with a posterior of made-up bodies.

use std::fs;
use std::path::Path;

/// Writes the file: the given sections, and each body's coupling, friction ratio, preload and discrepancy.
pub fn posterior(path: &Path, sections: &str, samples: &[[f64; 4]]) -> String {
    let text = |sample: &[f64; 4]| format!("{sample:?}");
    let samples: Vec<_> = samples.iter().map(text).collect();
    let file = format!(
        "{sections}[body]\ncoupling = 0.15\nfriction_ratio = 40.0\npreload_mm = 0.0007\n[posterior]\nformat = 1\norigin = \"virtual\"\n\
         made_by = \"a test\"\nseed = 1\nsampler = \"none\"\nr_hat = 1.0\ness = 10.0\nreliable = true\npoint = 1\n\
         parameters = [\"body.coupling\", \"body.friction_ratio\", \"body.preload_mm\", \"fit.discrepancy_mm\"]\n\
         samples = [{}]\n[[posterior.source]]\npath = \"made-up.csv\"\norigin = \"virtual\"\nsha256 = []\n\
         used = [\"row 1\", \"row 2\"]\nleft_out = []\n",
        samples.join(", ")
    );
    fs::write(path, file).expect("written");
    path.to_str().expect("UTF-8").to_owned()
}
