use slabcast_render::judge::reference::quadrature::*;

#[test]
fn four_gauss_nodes_integrate_degree_seven_exactly() {
    let g = Gauss::four_nodes();
    for power in 0..8 {
        let got: f64 = (0..4).map(|i| g.weights[i] * g.nodes[i].powi(power)).sum();
        assert!((got - 1.0 / f64::from(power + 1)).abs() < 1e-15, "power {power}: {got}");
    }
    for i in 0..4 {
        for power in 0..4 {
            let got: f64 = (0..4).map(|j| g.up_to[i][j] * g.nodes[j].powi(power)).sum();
            let want = g.nodes[i].powi(power + 1) / f64::from(power + 1);
            assert!((got - want).abs() < 1e-15, "node {i}, power {power}: {got}");
        }
    }
}
