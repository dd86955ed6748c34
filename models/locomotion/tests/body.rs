//! The chain of crescents: the indentation of each crescent and the movement of the whole body.

use locomotion::body::{Chain, Params};
use locomotion::roller;

const PARAMS: Params = roller::Params::PAPER.body;

#[test]
fn a_relaxed_body_lies_with_its_rearmost_tip_at_the_tail() {
    for tail_mm in [0.0, 12.5] {
        let chain = Chain::new(Params { tail_mm, ..PARAMS }).unwrap();
        let reach_mm = PARAMS.design.wing_reach_mm(0.0).unwrap();
        assert_eq!(chain.core_tail_mm(), tail_mm + reach_mm);
        assert_eq!(chain.displacement_mm(), 0.0);
        assert_eq!(chain.indentations_mm(), [0.0; 9]);
        assert_eq!(chain.links_mm(), [PARAMS.design.spacing_mm(); 9]);
        let length_mm = PARAMS.design.core_length_mm(0.0).unwrap();
        assert!((chain.head_mm() - chain.core_tail_mm() - length_mm).abs() < 1e-12);
    }
}

/// Under a sloping wall, each crescent takes its share of the indentation at the previous middle of its link.
#[test]
fn each_crescent_feels_the_wall_at_its_place() {
    let mut chain = Chain::new(PARAMS).unwrap();
    let wall_mm = |x: f64| x / 10.0;
    for _ in 0..3 {
        let mut x_mm = chain.core_tail_mm();
        let links: Vec<f64> = chain.links_mm().to_vec();
        chain.step(wall_mm).unwrap();
        for ((link, felt), squeezed) in links
            .iter()
            .zip(chain.indentations_mm())
            .zip(chain.links_mm())
        {
            let expected = PARAMS.coupling * wall_mm(x_mm + link / 2.0);
            assert!((felt - expected).abs() < 1e-12, "{felt} for {expected}");
            assert_eq!(*squeezed, PARAMS.design.squeezed_spacing_mm(*felt).unwrap());
            x_mm += link;
        }
        let length_mm: f64 = chain.links_mm().iter().sum();
        assert_eq!(chain.head_mm(), chain.core_tail_mm() + length_mm);
        assert_eq!(chain.indentations_mm().len(), 9);
    }
}

/// Squeezed at the head only, the body holds there and pulls its tail up.
#[test]
fn the_squeezed_end_holds() {
    let mut chain = Chain::new(PARAMS).unwrap();
    let (tail_mm, head_mm) = (chain.core_tail_mm(), chain.head_mm());
    let middle_mm = f64::midpoint(tail_mm, head_mm);
    chain
        .step(|x| if x > middle_mm { 3.0 } else { 0.0 })
        .unwrap();
    let (tail_moved, head_moved) = (chain.core_tail_mm() - tail_mm, chain.head_mm() - head_mm);
    assert!(
        tail_moved > 1.0 && head_moved.abs() < tail_moved / 4.0,
        "{tail_moved} {head_moved}"
    );
    assert_eq!(chain.displacement_mm(), tail_moved);
}
